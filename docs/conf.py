"""Settings of the site: make docs."""

import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
# Signatures and docstrings are all that is wanted of the package: nothing is compiled.
os.environ["NUMBA_DISABLE_JIT"] = "1"

import fdi_ros  # noqa: E402

project = "fdi_ros"
author = "fdi_ros maintainers"
version = release = fdi_ros.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}

# Anchors as on the usual hosts of repositories, so that a link works in both places; Sphinx checks them.
myst_heading_anchors = 3

# A name in single backticks, as docstrings have them.
default_role = "code"

# ROS 2 need not be installed where the site is built.
autodoc_mock_imports = ["rclpy", "builtin_interfaces", "diagnostic_msgs", "rcl_interfaces", "sensor_msgs", "std_msgs"]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
python_use_unqualified_type_names = True
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"fdi_ros {version}"
html_copy_source = False
html_show_sphinx = False


def as_written(
    app: Any, what: str, name: str, thing: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Show the types of arrays in signatures as the sources have them, not what they stand for."""

    def shorter(text: str | None) -> str | None:
        if text is None:
            return None
        text = re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
        return re.sub(
            r"(?:numpy\.)?ndarray\[tuple\[Any, \.\.\.\], (?:numpy\.)?dtype\[([\w.]+)\]\]", r"NDArray[\1]", text
        )

    return shorter(signature), shorter(returns)


def setup(app: Any) -> None:
    """Connect what this site adds to Sphinx."""
    app.connect("autodoc-process-signature", as_written)
