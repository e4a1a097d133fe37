"""Options of the documentation as a site: `make docs` builds it into build/docs.

Its source is the whole repository, because the pages are those that the repository's own readers see: links between
README.md, DESIGN.md and docs/ lead to the same places in both.
"""

import nbavatar

project = "NBAvatar"
author = "The NBAvatar open implementation authors"
copyright = f"2026, {author}"
release = version = nbavatar.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"
include_patterns = ["*.md", "config/README.md", "resources/README.md", "docs/**.md", "docs/**.ipynb"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}

nb_execution_mode = "off"  # a notebook holds its pictures; a test runs it
myst_heading_anchors = 3
myst_links_external_new_tab = False

default_role = "code"  # docstrings write names in single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"NBAvatar {release}"
html_show_sphinx = False
html_copy_source = False
