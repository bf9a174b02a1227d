# SPDX-License-Identifier: Apache-2.0
"""One self-contained HTML page: text, tables and pictures in a single file that needs nothing else.

The markup is also well-formed XML. All text that comes from outside is escaped here, and only here.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

STYLE = """
:root { color-scheme: light dark; --ink: #22262c; --soft: #5b6470; --ground: #f6f7f9; --card: #ffffff;
  --line: #dfe3e8; --accent: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaed; --soft: #a3abb6; --ground: #15181c; --card: #1e2329;
  --line: #333a43; --accent: #56b4e9; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 16px 64px; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 4px; text-wrap: balance; }
h2 { font-size: 1.25rem; margin: 0 0 12px; }
p { margin: 0 0 10px; }
.about, figcaption, footer { color: var(--soft); }
.about { overflow-wrap: anywhere; }
nav { display: flex; flex-wrap: wrap; gap: 6px 8px; margin: 18px 0 22px; }
nav a { color: var(--accent); text-decoration: none; border: 1px solid var(--line); border-radius: 999px;
  padding: 3px 12px; font-size: 0.9rem; background: var(--card); }
nav a:hover, nav a:focus { border-color: var(--accent); }
section { background: var(--card); border: 1px solid var(--line); border-radius: 12px; padding: 20px;
  margin: 0 0 20px; scroll-margin-top: 12px; }
figure { margin: 0; }
.scroll { overflow-x: auto; }
.picture { background: #ffffff; border-radius: 8px; padding: 8px; }
.picture img { display: block; margin: 0 auto; max-width: 100%; height: auto; }
.wide img { min-width: 760px; width: 100%; }
figcaption { margin-top: 10px; font-size: 0.95rem; max-width: 75ch; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: 7px 14px 7px 0; border-bottom: 1px solid var(--line); }
tr:last-child > * { border-bottom: 0; }
tbody th { font-weight: 600; white-space: nowrap; }
td { overflow-wrap: anywhere; }
td.number, th.number { text-align: right; white-space: nowrap; }
code { font: 0.9em/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; overflow-wrap: anywhere; }
@media (max-width: 560px) { section { padding: 14px; border-radius: 10px; } h1 { font-size: 1.5rem; }
  nav { flex-wrap: nowrap; overflow-x: auto; padding-bottom: 4px; } nav a { white-space: nowrap; }
  .facts tr { display: block; border-bottom: 1px solid var(--line); padding: 6px 0; }
  .facts tr:last-child { border-bottom: 0; } .facts th, .facts td { display: block; border: 0; padding: 0; } }
@media print { nav { display: none; } section { break-inside: avoid; } }
"""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        rows: cells as text.
        head: column headings; empty for a table of (name, value) rows.
        code_values: show the values as code.
    """

    rows: Sequence[Sequence[str]]
    head: Sequence[str] = ()
    code_values: bool = False


@dataclass(frozen=True)
class Section:
    """One card of the page.

    Attributes:
        key: the anchor in the page, a plain word.
        heading: its title.
        text: caption of the picture, or a paragraph without one.
        png: the picture.
        alt: what the picture shows, for people who do not see it.
        wide: the picture keeps a readable width and scrolls sideways on a phone.
        tables: shown below.
    """

    key: str
    heading: str
    text: str = ""
    png: bytes | None = None
    alt: str = ""
    wide: bool = False
    tables: Sequence[Table] = field(default_factory=tuple)


def build_page(title: str, about: Sequence[str], sections: Sequence[Section], footer: str) -> str:
    """The whole page as text.

    Args:
        title: heading, also the browser's title.
        about: lines below the heading.
        sections: in reading order.
        footer: last line.
    """
    links = "".join(f'<a href="#{escape(s.key)}">{escape(s.heading)}</a>' for s in sections)
    lines = "".join(f"<p class='about'>{escape(line)}</p>\n" for line in about)
    body = "\n".join(_section(s) for s in sections)
    return (
        "<!DOCTYPE html>\n"
        '<html lang="en">\n<head>\n<meta charset="utf-8"/>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n<header>\n<h1>{escape(title)}</h1>\n{lines}</header>\n"
        f'<nav aria-label="Sections">{links}</nav>\n'
        f"{body}\n<footer><p>{escape(footer)}</p></footer>\n</main>\n</body>\n</html>\n"
    )


def _section(section: Section) -> str:
    parts = [f'<section id="{escape(section.key)}">\n<h2>{escape(section.heading)}</h2>']
    if section.png is not None:
        data = base64.b64encode(section.png).decode("ascii")
        wide = " wide" if section.wide else ""
        parts.append(
            f'<figure>\n<div class="picture scroll{wide}"><img alt="{escape(section.alt or section.heading)}" '
            f'src="data:image/png;base64,{data}"/></div>\n<figcaption>{escape(section.text)}</figcaption>\n</figure>'
        )
    elif section.text:
        parts.append(f"<p>{escape(section.text)}</p>")
    parts += [_table(table) for table in section.tables]
    return "\n".join([*parts, "</section>"])


def _table(table: Table) -> str:
    head = ""
    if table.head:
        cells = "".join(f'<th scope="col"{_number(i)}>{escape(text)}</th>' for i, text in enumerate(table.head))
        head = f"<thead><tr>{cells}</tr></thead>"
    rows = []
    for name, *values in table.rows:
        texts = [f"<code>{escape(v)}</code>" if table.code_values else escape(v) for v in values]
        numbers = [_number(i + 1) if table.head else "" for i in range(len(texts))]
        cells = "".join(f"<td{number}>{text}</td>" for number, text in zip(numbers, texts, strict=True))
        rows.append(f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>')
    kind = "" if table.head else ' class="facts"'
    return f'<div class="scroll"><table{kind}>{head}<tbody>{"".join(rows)}</tbody></table></div>'


def _number(column: int) -> str:
    return ' class="number"' if column else ""
