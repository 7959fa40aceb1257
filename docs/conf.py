"""The site of the documentation, `make docs`: the pages as they are, and a reference made of docstrings."""

import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.transforms import SphinxTransform

import jvr
from docs import reference

project, author, release = "jvr", "the authors of jvr", jvr.__version__
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**.md"]
exclude_patterns = [".*", "build", "jvr", "tests"]
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"jvr {release}"
html_theme_options = {"top_of_page_buttons": []}
html_copy_source = False
html_math_renderer = "mathml"

GUIDE = (
    "rendering",
    "light",
    "occlusion",
    "environment_lighting",
    "surfaces",
    "fitting",
    "voxels",
    "derivatives",
    "files",
    "speed",
    "peers",
)
CONTENTS = {
    "Guide": [f"docs/{name}" for name in GUIDE],
    "Reference": [f"docs/reference/{name}" for name in reference.PARTS],
    "Project": ["CONTRIBUTING", "CHANGELOG"],
}


def with_contents(app, page: str, source: list[str]) -> None:
    """The first page holds the contents of the site, which its text does not show."""
    if page == root_doc:
        for caption, names in CONTENTS.items():
            source[0] += "\n".join(["", "", "```{toctree}", ":hidden:", f":caption: {caption}", "", *names, "```", ""])


class Linked(SphinxTransform):
    """Public names in code lead to their place in the reference."""

    default_priority = 400

    def apply(self, **_) -> None:
        known = reference.public()
        for literal in list(self.document.findall(nodes.literal)):
            name = re.fullmatch(r"(?:jvr\.)?([\w.]+)(\(.*\))?", literal.astext(), re.DOTALL)
            if name and f"jvr.{name[1]}" in known and not isinstance(literal.parent, nodes.reference):
                link = pending_xref(
                    "", refdoc=self.env.docname, refdomain="py", reftype="obj", reftarget=f"jvr.{name[1]}", refwarn=True
                )
                literal.replace_self(link)
                link += literal


def inline(writer, node) -> None:
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def displayed(writer, node) -> None:
    """Equations as MathML, which browsers draw by themselves."""
    writer.body.append(f'<div class="math" style="padding: 0.5em 0">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app) -> None:
    reference.write(Path(app.srcdir) / "docs" / "reference")
    app.connect("source-read", with_contents)
    app.add_transform(Linked)
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
