"""A report as one HTML file that loads nothing from elsewhere."""

from __future__ import annotations

from html import escape

from typing_extensions import assert_never

from curation_ros.reporting.blocks import Block, Figure, Page, Points, Section, Table, Text

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --line: #d7d7d7; --soft: #f4f4f2;
  --warn: #8a4b00; --warn-soft: #fff4e0; --link: #0a5ca8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --paper: #16181a; --line: #3b3f43;
  --soft: #202326; --warn: #ffc87a; --warn-soft: #3a2c14; --link: #8ec5ff; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: 0.5rem 0 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 0.6rem; border-bottom: 1px solid var(--line); }
.question { font-size: 1.1rem; margin: 0.2rem 0 1rem; }
p, li { max-width: 80ch; }
.caption { font-size: 0.875rem; line-height: 1.4; max-width: 120ch; margin: 0.8rem 0 0.3rem; }
li { margin: 0.25rem 0; overflow-wrap: anywhere; }
nav ol { margin: 0; padding-left: 1.4rem; columns: 22rem 2; }
a { color: var(--link); }
.warning { color: var(--warn); background: var(--warn-soft); padding: 0.4rem 0.7rem;
  border-left: 4px solid var(--warn); }
figure { margin: 1rem 0 1.5rem; }
.panels { display: grid; gap: 0.6rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 340px), 1fr)); }
.panels > div { background: #fff; border: 1px solid var(--line); border-radius: 4px;
  padding: 0.3rem; }
.panels svg { display: block; width: 100%; height: auto; max-width: 600px; margin: 0 auto; }
figcaption { font-size: 0.875rem; text-align: left; color: inherit; margin: 0.4rem 0; }
.wide { overflow: auto; max-height: 80vh; width: fit-content; max-width: 100%;
  border: 1px solid var(--line); border-radius: 4px;
  margin: 0.3rem 0 1.5rem; }
table { border-collapse: separate; border-spacing: 0; font-size: 0.84rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid var(--line); text-align: right;
  white-space: nowrap; vertical-align: top; }
th.text, td.text { text-align: left; }
td.text.long { white-space: normal; min-width: 18rem; }
thead th { position: sticky; top: 0; background: var(--soft); z-index: 2; vertical-align: bottom;
  white-space: normal; }
tbody th { position: sticky; left: 0; background: var(--soft); font-weight: 600; z-index: 1; }
tbody th wbr { display: none; }
thead th:first-child { left: 0; z-index: 3; }
@media (max-width: 600px) { main { padding: 0.6rem; } tbody th { white-space: normal; }
  tbody th wbr { display: inline; } }
@media print { .wide { max-height: none; overflow: visible; border: 0; } body { font-size: 10pt; }
  table { font-size: 6.5pt; } th, td { white-space: normal; padding: 0.1rem 0.2rem; }
  figure, tr { break-inside: avoid; } nav { display: none; } }
"""
#: Texts longer than this are wrapped in their cell.
_LONG = 40


def to_html(page: Page) -> str:
    """The whole HTML file."""
    contents = "".join(
        f'<li><a href="#part-{k}">{escape(s.title)}</a></li>'
        for k, s in enumerate(page.sections, 1)
    )
    body = "\n".join(_section(k, s) for k, s in enumerate(page.sections, 1))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(page.title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<main>
<h1>{escape(page.title)}</h1>
<p class="question">{escape(page.subtitle)}</p>
<nav aria-label="Contents"><ol>{contents}</ol></nav>
{body}
</main>
</body>
</html>
"""


def _section(k: int, section: Section) -> str:
    blocks = "\n".join(_block(b) for b in section.blocks)
    return f'<section id="part-{k}">\n<h2>{k}. {escape(section.title)}</h2>\n{blocks}\n</section>'


def _block(block: Block) -> str:
    match block:
        case Text():
            look = ' class="warning"' if block.is_warning else ""
            return f"<p{look}>{escape(block.text)}</p>"
        case Points():
            return "<ul>" + "".join(f"<li>{escape(i)}</li>" for i in block.items) + "</ul>"
        case Table():
            return _table(block)
        case Figure():
            panels = "".join(f"<div>{panel.svg}</div>" for panel in block.panels)
            caption = f"<figcaption>{escape(block.caption)}</figcaption>"
            return f'<figure>{caption}<div class="panels">{panels}</div></figure>'
        case _:
            assert_never(block)


def _table(table: Table) -> str:
    head = "".join(
        f'<th scope="col"{_side(k in table.text)}>{escape(h)}</th>'
        for k, h in enumerate(table.headings)
    )
    rows = "".join(f"<tr>{_cells(row, table.text)}</tr>\n" for row in table.rows)
    # Inside the table, the caption would scroll away with a wide one.
    return (
        f'<p class="caption">{escape(table.caption)}</p>\n'
        f'<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}</tbody></table></div>"
    )


def _cells(row: tuple[str, ...], text: tuple[int, ...]) -> str:
    # <wbr> marks where a narrow screen may break the long name of a row.
    name = escape(row[0]).replace("_", "_<wbr>")
    first = f'<th scope="row" class="text">{name}</th>'
    return first + "".join(
        f"<td{_side(k in text, len(cell) > _LONG)}>{escape(cell)}</td>"
        for k, cell in enumerate(row[1:], 1)
    )


def _side(is_text: bool, is_long: bool = False) -> str:
    if not is_text:
        return ""
    return ' class="text long"' if is_long else ' class="text"'
