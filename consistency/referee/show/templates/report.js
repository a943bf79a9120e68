// A checkbox shows or hides everything of one filter in one study: glyphs and legend entries.
"use strict";
document.addEventListener("change", (event) => {
  const mark = event.target.dataset.switch;
  if (mark === undefined) return;
  const shown = event.target.checked;
  for (const doc of Bokeh.documents)
    for (const chart of doc.roots())
      for (const glyph of chart.renderers)
        if (glyph.tags.includes(mark)) glyph.visible = shown;
  for (const entry of document.querySelectorAll("li[data-filter]"))
    if (entry.dataset.filter === mark) entry.classList.toggle("off", !shown);
});
