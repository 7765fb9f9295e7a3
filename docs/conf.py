"""How Sphinx builds the site: `make docs`."""

import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).parent.resolve()
sys.path.insert(0, str(DOCS.parent))

from mtsp_env import __version__  # noqa: E402

project = "mtsp-env"
author = copyright = "The mtsp-env authors"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
nitpicky = False

html_theme = "furo"
html_title = "mtsp-env"
html_static_path = ["_static"]
html_css_files = ["tables.css"]

# Markdown
myst_enable_extensions = ["attrs_inline", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

# API pages
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
autodoc_default_options = {"members": True, "show-inheritance": False}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

# Links of the pages lead to files of the repository, since a code host shows them as well. These files are pages here.
PAGES_OF_FILES = {
    "../README.md": "index.md",
    "../CONTRIBUTING.md": "contributing.md",
    "../CHANGELOG.md": "changelog.md",
    "../dan_policy/weights/README.md": "model-cards.md",
    "../benchmarks/policies/weights/README.md": "measured/networks.md",
    "../benchmarks/results/report.md": "measured/report.md",
    "../benchmarks/results/ablations.md": "measured/ablations.md",
    "../benchmarks/results/clip.md": "measured/clip.md",
    "../benchmarks/results/confidence.md": "measured/confidence.md",
    "../benchmarks/results/exact.md": "measured/exact.md",
    "../benchmarks/results/reference-gaps.md": "measured/reference-gaps.md",
    "../benchmarks/results/search.md": "measured/search.md",
    "../benchmarks/results/seed3333/report.md": "measured/seed3333.md",
    "../benchmarks/results/table1-100/report.md": "measured/table1-100.md",
    "../benchmarks/results/view.md": "measured/view.md",
    "../benchmarks/results/worlds/report.md": "measured/worlds.md",
}
LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")  # but no pictures


def _leads_to(target: str, folder: Path) -> str:
    """Where a link of a file in ``folder`` leads on the site: a page, or else the file, as a download."""
    if target.startswith(("http:", "https:", "mailto:")):
        return target
    file = (folder / target).resolve()
    for name, page in PAGES_OF_FILES.items():
        if file == (DOCS / name).resolve():
            return f"/{page}"
    return f"/{os.path.relpath(file, DOCS)}"


def _adapt_links(source: list[str], folder: Path) -> None:
    def replace(link: re.Match) -> str:
        return f"[{link['text']}]({_leads_to(link['target'], folder)}{link['anchor'] or ''})"

    source[0] = LINK.sub(replace, source[0])


def setup(app: object) -> None:
    """Let links between files of the repository lead to the pages of the site."""
    app.connect("source-read", lambda app, page, source: _adapt_links(source, (DOCS / page).parent))
    app.connect("include-read", lambda app, file, page, source: _adapt_links(source, (DOCS / file).resolve().parent))
