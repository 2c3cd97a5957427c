"""The documentation as pages: files of ``docs``, which a wheel has too, and pages of reference."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from itertools import pairwise
from pydoc import locate
from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from fastapi import Request
from fastapi.responses import RedirectResponse, Response
from markdown_it import MarkdownIt
from markdown_it.token import Token
from mdit_py_plugins.dollarmath import dollarmath_plugin

from starcat.cli import REFERENCE
from starcat.resources import resource_folder
from starcat_service.pages.rendering import page_router, render
from starcat_service.problems import Problem

router = page_router()

FOLDER = resource_folder("docs")
NAMES = frozenset(path.stem for path in FOLDER.glob("*.md")) | frozenset(REFERENCE)
FIGURES = {path.name: path for path in (FOLDER / "figures").iterdir() if path.is_file()}
"""Pages and pictures that there are: no path is ever made of a request."""

INDEX = "index"
_FIGURE_TYPES = {".svg": "image/svg+xml", ".png": "image/png"}
_TITLE = re.compile(r"^# (.+)$", re.MULTILINE)
_TREE = re.compile(
    r"^```\{toctree\}\n:caption: (.+)\n(?::.*\n)*\n((?:[\w-]+\n)+)```$", re.MULTILINE
)
_AUTO = re.compile(r"^\.\. auto(?:function|class):: (\S+)$", re.MULTILINE)


@dataclass(frozen=True)
class Page:
    """A page of the documentation."""

    title: str
    body: str  # HTML
    parts: list[tuple[str, str]]  # id and words of its headings


@dataclass(frozen=True)
class PagePart:
    """Pages that belong together."""

    caption: str
    pages: list[tuple[str, str]]  # name and title


@router.get("/docs")
def contents(request: Request) -> Response:
    """Show what there is to read."""
    return _shown(request, INDEX)


@router.get("/docs/{name}")
def page_of(request: Request, name: str) -> Response:
    """Show a page."""
    if name.removesuffix(".md") != name or name == INDEX:
        return RedirectResponse(f"/docs/{name.removesuffix('.md')}".removesuffix("/index"), 308)
    if name not in NAMES:
        raise Problem(404, f"the documentation has no page {name[:60]!r}; /docs lists all of them")
    return _shown(request, name)


@router.get("/docs/figures/{name}")
def documentation_figure(name: str) -> Response:
    """Give a picture of a page."""
    if name not in FIGURES:
        raise Problem(404, "there is no such picture; /docs lists the pages")
    path = FIGURES[name]
    headers = {"Cache-Control": "private, max-age=86400"}
    return Response(path.read_bytes(), media_type=_FIGURE_TYPES[path.suffix], headers=headers)


def _shown(request: Request, name: str) -> Response:
    return render(request, "docs.html", name=name, page=read_page(name), contents=table_of_pages())


@cache
def table_of_pages() -> list[PagePart]:
    """Return the pages by part, as the index has them."""
    return [
        PagePart(caption, [(name, _title(name)) for name in names.split()])
        for caption, names in _TREE.findall(_text(INDEX))
    ]


@cache
def _text(name: str) -> str:
    """Return a page as Markdown; pages of reference are made from the program that runs."""
    if name in REFERENCE:
        return REFERENCE[name]()
    return (FOLDER / f"{name}.md").read_text(encoding="utf-8")


def _title(name: str) -> str:
    found = _TITLE.search(_text(name))
    return found[1] if found else name


@cache
def read_page(name: str) -> Page:
    """Return a page."""
    text = _TREE.sub("", _text(name))
    markdown = _markdown()
    tokens = markdown.parse(text)
    parts = _with_anchors(tokens)
    for token in tokens:
        for inline in token.children or ():
            _lead_here(inline)
    return Page(_title(name), markdown.renderer.render(tokens, markdown.options, {}), parts)


@cache
def _markdown() -> MarkdownIt:
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    dollarmath_plugin(markdown, allow_blank_lines=False, renderer=_formula)
    rules: Any = vars(markdown.renderer)["rules"]
    # Tables wider than the page scroll in a box of their own, which the keyboard reaches.
    rules["table_open"] = _table
    rules["table_close"] = lambda *_: "</table>\n</div>\n"
    rules["th_open"] = rules["td_open"] = _cell
    rules["th_close"] = lambda *_: ""  # HTML ends a cell where the next begins
    rules["fence"] = rules["code_block"] = _code
    return markdown


def _formula(tex: str, options: dict[str, bool]) -> str:
    """Return a formula as MathML, which browsers draw without a script."""
    return str(tex2mathml(tex.strip(), as_block=options["display_mode"]))


def _table(tokens: Sequence[Token], index: int, _: Any, environment: dict[str, int]) -> str:
    number = environment["tables"] = environment.get("tables", 0) + 1
    box = f'<div class="scroll" tabindex="0" role="region" aria-label="Table {number}">'
    return f'{box}\n<table class="grid">\n'


def _cell(tokens: Sequence[Token], index: int, *_: Any) -> str:
    token = tokens[index]
    tag = "td" if not tokens[index + 1].content else token.tag  # a head without words is none
    kind = ' class="number"' if "right" in str(token.attrGet("style")) else ""
    return f"<{tag}{kind}>"


def _code(tokens: Sequence[Token], index: int, *_: Any) -> str:
    token = tokens[index]
    if token.info.strip() == "{eval-rst}":
        return "".join(map(_described, _AUTO.findall(token.content)))
    if included := re.fullmatch(r"\{literalinclude\} notebooks/(\w+)\.py", token.info.strip()):
        notebook = FOLDER / "notebooks" / f"{included[1]}.py"
        return f'<pre tabindex="0"><code>{escape(notebook.read_text("utf-8"))}</code></pre>\n'
    return f'<pre tabindex="0"><code>{escape(token.content)}</code></pre>\n'


def _described(name: str) -> str:
    """Return the documentation of a function, or of a class with its methods."""
    thing: Any = locate(name)
    words = inspect.getdoc(thing) or ""
    if inspect.isclass(thing):
        methods = {k: v for k, v in inspect.getmembers(thing, callable) if k[0] != "_"}
        told = [f"{_signed(k, v)}\n    {_first_line(v)}" for k, v in methods.items()]
        words += "\n\n" + "\n".join(told) if told else ""
    head = _signed(name.rpartition(".")[2], thing)
    code = f'<pre tabindex="0"><code>{escape(words)}</code></pre>'
    return f'<h3 class="code"><code>{escape(head)}</code></h3>\n{code}\n'


def _signed(name: str, thing: Any) -> str:
    try:
        return name + re.sub(r" -> .*| = <.*?>|'", "", str(inspect.signature(thing)))
    except (TypeError, ValueError):
        return name


def _first_line(thing: Any) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0]


def _with_anchors(tokens: list[Token]) -> list[tuple[str, str]]:
    """Give headings the names that links use; return the headings of the second level."""
    parts = []
    for opening, inline in pairwise(tokens):
        if opening.type == "heading_open":
            words = "".join(one.content for one in inline.children or ())
            anchor = re.sub(r"[^\w\- ]", "", words.lower()).strip().replace(" ", "-")
            opening.attrSet("id", anchor)
            if opening.tag == "h2":
                parts.append((anchor, words))
    return parts


def _lead_here(token: Token) -> None:
    """Let a link between files lead to a page; one to a file of the source leads nowhere here."""
    if token.type == "image":
        token.attrSet("src", f"/docs/{token.attrGet('src')}")
    if token.type != "link_open":
        return
    target = str(token.attrGet("href"))
    file, mark, anchor = target.partition("#")
    if target.startswith(("http://", "https://")):
        token.attrSet("rel", "noreferrer")
    elif file.removesuffix(".md") in NAMES:
        token.attrSet(
            "href", f"/docs/{file.removesuffix('.md')}".removesuffix("/index") + mark + anchor
        )
    elif file:
        del token.attrs["href"]
