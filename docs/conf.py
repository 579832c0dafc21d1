"""How the pages in this directory become a site: `sphinx-build -W -E docs out/docs`.

The pages are plain Markdown, to be read in the repository as well; what only the site has, its list
of pages and whole files, is put in for comments here.
"""

import re
from typing import Any

from risaf_link import __version__

PAGES = {
    "Set it up": ["Install <install>", "configure", "PX4 <px4>", "ArduPilot <ardupilot>"],
    "Use it": ["mavlink", "mavproxy", "monitor", "recording", "mqtt", "metrics"],
    "Judge it": ["looking-back", "tune", "troubleshoot"],
    "Know it": ["architecture", "faults", "threats", "routers"],
}
"""Captions to their pages, in order. A page that stands nowhere here is an error of the build."""

OUTSIDE = re.compile(r"\]\((\.\./[^)#]+\.md)(?:#[^)]*)?\)")
"""Links to Markdown that is no page of the site: a file like any other."""

project = "risaf_link"
author = "The risaf_link authors"
version = release = __version__
project_copyright = author
extensions = ["myst_parser"]
exclude_patterns = ["_*"]
nitpicky = True

myst_heading_anchors = 3  # as the forge makes them

html_theme = "furo"
html_title = f"risaf_link {version}"
html_copy_source = False
html_show_sphinx = False
html_static_path: list[str] = []
pygments_style = "tango"


def put_in(app: Any, name: str, source: list[str]) -> None:
    """Put in what the site alone has."""
    del app, name
    source[0] = source[0].replace("<!-- pages -->", contents())
    source[0] = re.sub(r"<!-- whole: (\S+) (\w+) -->", whole, source[0])
    source[0] = OUTSIDE.sub(r"](path:\1)", source[0])


def contents() -> str:
    """The list of pages."""
    trees = []
    for caption, pages in PAGES.items():
        head = f"```{{toctree}}\n:hidden:\n:caption: {caption}\n\n"
        trees.append(head + "\n".join(pages) + "\n```\n")
    return "\n".join(trees)


def whole(found: re.Match[str]) -> str:
    """A file of the repository, in a language."""
    return f"```{{literalinclude}} {found[1]}\n:language: {found[2]}\n```"


def setup(app: Any) -> None:
    """Let pages pass through `put_in`."""
    app.connect("source-read", put_in)
