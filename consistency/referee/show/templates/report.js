// A checkbox shows or hides everything of one filter in one study.
"use strict";
document.addEventListener("change", (event) => {
  const tag = event.target.dataset.filter;
  if (tag === undefined) return;
  for (const part of document.querySelectorAll(`.filter-${tag}`)) part.style.display = event.target.checked ? "" : "none";
});
