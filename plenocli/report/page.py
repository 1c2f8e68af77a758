"""A page in one file: headings, text, tables and pictures (inside, as base64), all text escaped."""

import base64
import html
from collections.abc import Mapping, Sequence, Set
from pathlib import Path

from plenocli.base.text import printable_lines
from plenocli.report.drawing import compact


def _escaped(text: str) -> str:
    return html.escape(printable_lines(text))


class Page:
    """Collects blocks in order; `render` gives the HTML. Texts are plain text, never markup."""

    def __init__(self, title: str, lead: str = "") -> None:
        """An empty page; `lead`: a paragraph below its title."""
        self._title, self._lead = title, lead
        self._blocks: list[str] = []
        self._sections: list[str] = []
        self._headings: list[tuple[int, str]] = []

    def section(self, title: str, text: str = "") -> None:
        """A numbered-by-order main section with an entry in the list at the top."""
        self._sections.append(title)
        self._blocks.append(f'<h2 id="s{len(self._sections)}">{_escaped(title)}</h2>')
        self.text(text)

    def heading(self, title: str, text: str = "") -> None:
        """A heading below a section, in the list at the top too."""
        self._headings.append((len(self._sections), title))
        self._blocks.append(f'<h3 id="h{len(self._headings)}">{_escaped(title)}</h3>')
        self.text(text)

    def text(self, text: str) -> None:
        """One paragraph; nothing for an empty text."""
        if text:
            self._blocks.append(f"<p>{_escaped(text)}</p>")

    def warning(self, text: str) -> None:
        """A paragraph that stands out."""
        self._blocks.append(f'<p class="warning">{_escaped(text)}</p>')

    def cards(self, cards: Sequence[tuple[str, str]]) -> None:
        """Headline numbers: a sequence of (value, what it is)."""
        if cards:
            boxes = "".join(
                (f'<div class="card"><b>{_escaped(value)}</b><span>{_escaped(what)}</span></div>')
                for value, what in cards
            )
            self._blocks.append(f'<div class="cards">{boxes}</div>')

    def figure(self, png: bytes, caption: str = "") -> None:
        """A picture with its caption, which is also its description for those who cannot see it."""
        if png:
            data = base64.b64encode(compact(png)).decode("ascii")
            width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
            self._blocks.append(
                f'<figure><img src="data:image/webp;base64,{data}" width="{width * 100 // 130}" '
                f'height="{height * 100 // 130}" alt="{_escaped(caption or "picture")}">'
                f"<figcaption>{_escaped(caption)}</figcaption></figure>"
            )

    def figures(self, figures: Sequence[tuple[bytes, str]]) -> None:
        """Several pictures, (PNG, caption) each."""
        for png, caption in figures:
            self.figure(png, caption)

    def table(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[str]],
        caption: str = "",
        best: Mapping[int, Set[int]] | None = None,
        text: bool = False,
    ) -> None:
        """A table of text cells.

        header: of the columns.
        rows: cells of each row.
        caption: below it.
        best: row number -> set of columns set in bold.
        text: cells are words, aligned left.
        """
        best = best or {}
        head = "".join(f"<th>{_escaped(cell)}</th>" for cell in header)
        body = "".join(
            "<tr>"
            + "".join(
                (
                    f"<td{' class=best' if column in best.get(number, ()) else ''}>"
                    f"{_escaped(cell)}</td>"
                )
                for column, cell in enumerate(row)
            )
            + "</tr>"
            for number, row in enumerate(rows)
        )
        legend = f"<caption>{_escaped(caption)}</caption>" if caption else ""
        kind = ' class="text"' if text else ' class="wide"' if len(header) > 8 else ""
        self._blocks.append(
            f'<div class="scroll"><table{kind}>{legend}<thead><tr>{head}</tr></thead><tbody>{body}'
            "</tbody></table></div>"
        )

    def definitions(
        self, entries: Mapping[str, str], summary: str = "What the numbers mean"
    ) -> None:
        """Terms and what they mean, folded away: dict term -> text."""
        if entries:
            inner = "".join(
                f"<dt>{_escaped(term)}</dt><dd>{_escaped(text)}</dd>"
                for term, text in entries.items()
            )
            self._blocks.append(
                f"<details><summary>{_escaped(summary)}</summary><dl>{inner}</dl></details>"
            )

    def code(self, text: str, summary: str) -> None:
        """Text in a fixed-width block, folded away."""
        self._blocks.append(
            f"<details><summary>{_escaped(summary)}</summary><pre>{_escaped(text)}</pre></details>"
        )

    def _contents(self) -> str:
        """Links to the sections, each with its headings below it."""
        parts = []
        for number, title in enumerate(self._sections, start=1):
            below = "".join(
                f'<li><a href="#h{i}">{_escaped(text)}</a></li>'
                for i, (section, text) in enumerate(self._headings, start=1)
                if section == number
            )
            parts.append(
                f'<li><a href="#s{number}">{_escaped(title)}</a>'
                + (f"<ul>{below}</ul>" if below else "")
                + "</li>"
            )
        return f"<ol>{''.join(parts)}</ol>"

    def links(self, links: Sequence[tuple[str, str]]) -> None:
        """A list of (text, address) of other pages."""
        items = "".join(
            f'<li><a href="{html.escape(address)}">{_escaped(text)}</a></li>'
            for text, address in links
        )
        if items:
            self._blocks.append(f'<ul class="links">{items}</ul>')

    def others(self, names: Sequence[str]) -> None:
        """Files that a section does not draw, folded away; nothing for none."""
        if names:
            how = "plenocli view FILE -o view.html shows one"
            self.code("\n".join(names), f"{len(names)} more: {how}")

    def render(self) -> str:
        """The page as text. The same blocks give the same bytes."""
        style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
        nav = f"<nav>{self._contents()}</nav>" if len(self._sections) > 1 else ""
        lead = f'<p class="lead">{_escaped(self._lead)}</p>' if self._lead else ""
        return (
            (
                "<!doctype html>\n"
                '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
                'content="width=device-width, initial-scale=1">'
                f"<title>{_escaped(self._title)}</title>\n"
                "<style>\n"
                f"{style}</style></head>\n"
                "<body><main>\n"
                f"<h1>{_escaped(self._title)}</h1>\n"
                f"{lead}{nav}\n"
            )
            + "\n".join(self._blocks)
            + "\n</main></body></html>\n"
        )
