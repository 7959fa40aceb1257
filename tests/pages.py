"""The pages of the documentation as a Markdown parser reads them: blocks of code, code within sentences, links."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
PAGES = {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"))}
PROGRAMS = ("jvr", "python", "pytest", "make", "pip")
# Stands above a block that a test cannot run: `<!-- not run: needs a graphics card -->`.
NOT_RUN = re.compile(r"<!-- not run: (.+) -->")
PARSER = MarkdownIt("commonmark").enable("table")


class Block(NamedTuple):
    """A fenced block, the line of its first, and why it is not run, if so."""

    page: str
    line: int
    language: str
    code: str
    not_run: str | None

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(language: str | None = None) -> list[Block]:
    """All blocks of all pages in order, or those of one language."""
    found = []
    for page, text in PAGES.items():
        before: Token | None = None
        for token in PARSER.parse(text):
            if token.type == "fence":
                reason = NOT_RUN.match(before.content) if before is not None and before.type == "html_block" else None
                found.append(Block(page, token.map[0] + 2, token.info, token.content, reason and reason[1]))
            before = token
    return [block for block in found if language in (None, block.language)]


def _inline(text: str) -> Iterator[tuple[int, Token]]:
    """Parts of paragraphs and of cells of tables, with the line where those begin."""
    for token in PARSER.parse(text):
        for child in token.children or ():
            yield token.map[0] + 1, child


def spans(text: str) -> Iterator[tuple[int, str]]:
    """Code within sentences."""
    return ((line, " ".join(child.content.split())) for line, child in _inline(text) if child.type == "code_inline")


def links(text: str) -> list[str]:
    """What links and pictures lead to."""
    found = (child.attrs.get("href", child.attrs.get("src")) for _, child in _inline(text))
    return [str(target) for target in found if target is not None]


def sources() -> dict[str, str]:
    """What experiments, benchmarks and configurations say of themselves."""
    programs = [*ROOT.glob("experiments/*.py"), *ROOT.glob("benchmarks/**/*.py")]
    found = {p: ast.get_docstring(ast.parse(p.read_text(encoding="utf-8"))) or "" for p in programs}
    for path in ROOT.glob("configs/**/*.toml"):
        comments = (line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("#"))
        found[path] = "\n".join(line.lstrip("# ") for line in comments)
    return {path.relative_to(ROOT).as_posix(): text for path, text in found.items()}


def commands() -> Iterator[tuple[str, list[str]]]:
    """Every command of every page and source: where it stands, and its words."""
    for block in blocks("sh"):
        for number, line in enumerate(block.code.splitlines()):
            yield f"{block.page}:{block.line + number}", words_of(line)
    for name, text in (PAGES | sources()).items():
        for line, span in spans(text):
            words = words_of(span)
            if len(words) > 1 and words[0] in PROGRAMS:
                yield f"{name}:{line}", words


def words_of(line: str) -> list[str]:
    """The words of a command without the variables that it sets; what a synopsis has in brackets counts as given."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:  # a quotation mark of something else
        return []
    while words and re.match("[A-Z_]+=", words[0]):
        words.pop(0)
    if words[:1] != ["pip"]:
        words = [word.strip("[]") for word in words]
    return [word for word in words if word not in ("...", "NAME")]
