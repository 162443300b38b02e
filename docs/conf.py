"""How the documentation site is built: ``sphinx-build -W --keep-going -b html docs out/site``,
without network.
"""

import importlib.metadata
import os
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS / "_ext"))
# The tutorial runs on the interpreter that builds the site, whatever kernels the user has
# installed.
os.environ["JUPYTER_PREFER_ENV_PATH"] = "1"

project = "ffsm_drake"
author = copyright = "The ffsm_drake developers"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "offline_math",
    "plain_docstrings",
    "settings_tables",
    "evidence_tables",
]
exclude_patterns = ["_ext", "joss"]
html_theme = "furo"
version = release = importlib.metadata.version("ffsm-drake")
html_title = f"ffsm_drake {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
myst_update_mathjax = False

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_ipywidgets_js = {}  # it would load RequireJS from the network
nb_merge_streams = True

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True
add_module_names = False
smartquotes = False  # docstrings write derivatives as q''
copybutton_exclude = ".linenos, .gp, .go"
