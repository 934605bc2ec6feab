"""Adds the pages of the site that do not lie in docs/, and leads links between files of the repository to pages."""

from __future__ import annotations

import ast
import json
import posixpath
import re
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
NOTEBOOK = "docs/examples/library.ipynb"
#: File of the repository -> page of the site. A page in docs/ keeps its name.
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "datasets/README.md": "datasets.md",
    NOTEBOOK: "examples/library.md",
}
FILES = {page: file for file, page in PAGES.items()}
#: How far up the search puts what it finds on a page, where that is not 1.
BOOST = {"paper.md": 10, "guide.md": 2, "deviations.md": 0.02, "changelog.md": 0.05}
API = """# Python API

`import hrcreplay as hr` gives these names; the [example](examples/library.md) uses most of them. Settings are those of
the [guide](guide.md#settings).

::: hrcreplay.api
    options:
      filters: public
      heading_level: 2
      show_root_heading: false
      show_root_toc_entry: false
"""

_BLOCK = re.compile(r"(^ *```.*?^ *```$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s#:]+)(#[^)\s]*)?\)")
_PLACE = re.compile(r"`(hrcreplay/[\w/]+\.(?:py|toml|proto))`((?:,? `[\w.]+`)*)")
_SECTION = re.compile(r"(?:\A|(?<=\n\n))(?=(?:# .*\n)*\[([\w.]+)\]$)", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages from elsewhere, the API, and the source files that pages name."""
    files.remove(files.src_uris[NOTEBOOK.removeprefix("docs/")])
    for file, page in PAGES.items():
        text = (ROOT / file).read_text()
        files.append(File.generated(config, page, content=notebook(text) if file == NOTEBOOK else text))
    files.append(File.generated(config, "api.md", content=API))
    texts = [file.content_string for file in files.documentation_pages()]
    named = {name for text in texts for name in re.findall(r"\bhrcreplay/[\w/]+\.(?:py|toml|proto)\b", text)}
    for name in sorted(name for name in named if (ROOT / name).is_file()):
        page = File.generated(config, f"{name}.md", content=source_page(name), inclusion=InclusionLevel.NOT_IN_NAV)
        files.append(page)
    return files


def on_page_markdown(markdown: str, *, page: Page, files: Files, config: MkDocsConfig) -> str:
    """Splits the settings by section, and leads links and places in the code to pages."""
    del config
    here = page.file.src_uri
    if here.startswith("hrcreplay/"):
        return markdown
    if here in BOOST:
        page.meta["search"] = {"boost": BOOST[here]}
    if here == "guide.md":
        markdown = _BLOCK.sub(lambda block: settings_by_section(block[0]), markdown)
    if here == "paper.md":
        markdown = re.sub(r"^\| \(", "| Eq. (", markdown, flags=re.MULTILINE)  # as one searches for it
    parts = _BLOCK.split(markdown)
    for i in range(0, len(parts), 2):  # those between are blocks of code
        text = _LINK.sub(lambda link: f"]({target(here, link[1], files)}{link[2] or ''})", parts[i])
        parts[i] = _PLACE.sub(lambda place: link_place(here, place[1], place[2], files), text)
    return "".join(parts)


def target(here: str, link: str, files: Files) -> str:
    """A link of a page between files of the repository, as a link between pages of the site."""
    file = posixpath.normpath(posixpath.join(posixpath.dirname(FILES.get(here, f"docs/{here}")), link))
    page = PAGES.get(file, f"{file}.md" if f"{file}.md" in files.src_uris else file.removeprefix("docs/"))
    return posixpath.relpath(page, posixpath.dirname(here))


def link_place(here: str, file: str, names: str, files: Files) -> str:
    """``file`` and names in it, each a link to its line in the page of the source."""
    page = files.src_uris.get(f"{file}.md")
    if page is None:
        return f"`{file}`{names}"
    url = posixpath.relpath(page.url, posixpath.dirname(here))

    def link(name: re.Match[str]) -> str:
        line = line_of(file, name[1])
        return name[0] if line is None else _anchor(f"{url}#__codelineno-0-{line}", name[1])

    return _anchor(url, file) + re.sub(r"`([\w.]+)`", link, names)


def _anchor(url: str, words: str) -> str:
    return f'<a href="{url}"><code>{words.replace("/", "/<wbr>").replace("_", "_<wbr>")}</code></a>'


@cache
def line_of(file: str, name: str) -> int | None:
    """The line on which a file defines a name, such as ``Plan.q_p``; of a TOML file, a key. None: it does not."""
    text = (ROOT / file).read_text()
    if not file.endswith(".py"):
        return next((i for i, line in enumerate(text.splitlines(), 1) if re.match(rf"{name}\b", line)), None)
    found: ast.AST | None = ast.parse(text)
    for part in name.split("."):
        found = found and next((node for node in ast.iter_child_nodes(found) if part in _defined(node)), None)
    return getattr(found, "lineno", None)


def _defined(node: ast.AST) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
    return {inner.id for each in targets for inner in ast.walk(each) if isinstance(inner, ast.Name)}


def source_page(file: str) -> str:
    """A page that shows a file with the numbers of its lines; the search leaves it out."""
    kind = {"py": "python", "toml": "toml", "proto": "protobuf"}[file.rpartition(".")[2]]
    head = f"---\ntitle: {file}\nhide: [toc]\nsearch: {{exclude: true}}\n---\n\n# {file}\n\n"
    return f'{head}````{kind} linenums="1"\n{(ROOT / file).read_text()}````\n'


def settings_by_section(block: str) -> str:
    """The list of all settings with a heading for each section, so that the search leads to the section."""
    body = block.removeprefix("```toml\n").removesuffix("```")
    _, *parts = _SECTION.split(body)
    if len(parts) < 4:
        return block
    return "\n".join(f"### {name}\n\n```toml\n{text}```\n" for name, text in zip(parts[::2], parts[1::2], strict=True))


def notebook(text: str) -> str:
    """The cells of a notebook as Markdown; it is stored without output."""
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]
    parts = [f"```python\n{source}\n```" if kind == "code" else source for kind, source in cells]
    return "\n\n".join([*parts, "The notebook itself: `docs/examples/library.ipynb`."]) + "\n"
