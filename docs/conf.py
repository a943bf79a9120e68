"""Settings of the documentation site: ``make docs`` builds it, offline and strictly, to docs/_build/html."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_extensions"))

project = "filter-consistency"
author = "The filter-consistency developers"
project_copyright = author
version = release = version_of("filter-consistency")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "myst_nb",
    "commands",
    "docstrings",
    "figures",
    "outside",
]
root_doc = "index"
exclude_patterns = ["_build", "case-studies", "examples/README.md", "gallery"]
exclude_patterns += ["generated/gallery/*.ipynb", "generated/gallery/*.json"]
highlight_language = "none"  # an indented block is a command or what it prints
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!consistency[.:]).*"),  # types and modules of others, or an alias of arrays
    # in signatures, not public
    (r"py:class", r"consistency\..*\.(DisparityGrowth|Lens|NoiseGroup|Observations|Parts|StepMoments)"),
    (r"py:class", r"consistency\..*\.(Reading|Results|StereoSequence|Source|Space|Sweep|Tables)"),
    # stages of the chain
    (r"py:class", r"consistency\..*\.stages\.(Correspondence|FeatureSelection|ObservationFilter|Tracking)"),
]

# pages
myst_heading_anchors = 4  # as on GitHub
nb_execution_mode = "off"  # the notebook is stored with its outputs, and a test executes it

# docstrings
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "Indices", "NDArray")}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True

# figures
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "generated/gallery",
    "image_scrapers": ("figures.figure_scraper",),
    "reset_modules": ("figures.plain_look",),
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "capture_repr": (),  # what is printed is shown, not what an expression is
    "write_computation_times": False,
    "min_reported_time": 60,
    "remove_config_comments": True,
    "abort_on_example_error": True,
}

# HTML
html_theme = "pydata_sphinx_theme"
html_title = project
html_context = {"default_mode": "auto"}
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_sidebars = {"**": ["globaltoc.html"]}  # all pages, in the sections of the landing page
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": project},
    "navbar_align": "left",
    "navbar_center": [],
    "navbar_end": ["theme-switcher"],
    "navigation_with_keys": False,
    "show_prev_next": True,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
