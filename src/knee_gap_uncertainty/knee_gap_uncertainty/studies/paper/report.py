"""The study as one HTML page that needs no other file."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from knee_gap_uncertainty.studies.paper.tables import shown

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light; }}
body {{
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", sans-serif;
  color: #1d1f24; background: #f6f7f9; margin: 0;
}}
main {{
  max-width: 1060px; margin: 0 auto; padding: 32px 24px 80px;
  background: #fff; box-shadow: 0 0 40px #0000000a;
}}
h1 {{ font-size: 28px; line-height: 1.25; margin: 0 0 8px; }}
h2 {{ font-size: 20px; margin: 44px 0 8px; padding-top: 14px; border-top: 1px solid #e6e8ec; }}
p {{ max-width: 78ch; }}
figure {{ margin: 18px 0; }}
figure img {{ width: 100%; height: auto; display: block; }}
figcaption {{ color: #5a606c; font-size: 14px; max-width: 90ch; }}
.scroll {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; margin: 12px 0; }}
th, td {{ padding: 5px 10px; text-align: right; border-bottom: 1px solid #e6e8ec; vertical-align: top; }}
th {{ color: #5a606c; font-weight: 600; white-space: nowrap; }}
td.text, th.text {{ text-align: left; max-width: 44ch; }}
.lead {{ color: #3a3f4a; font-size: 17px; }}
</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def page(title: str, parts: Iterable[str]) -> str:
    """The whole page."""
    return PAGE.format(title=html.escape(title), body="\n".join(parts))


def heading(text: str) -> str:
    """A section's heading."""
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{kind}">{html.escape(text)}</p>' if kind else f"<p>{html.escape(text)}</p>"


def picture(path: Path, caption: str) -> str:
    """A PNG file within the page."""
    data = base64.b64encode(path.read_bytes()).decode()
    words = html.escape(caption)
    image = f'<img alt="{words}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{words}</figcaption></figure>"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; columns of numbers to the right, columns with words to the left."""
    worded = [
        any(not isinstance(value, int | float) for value in column) for column in zip(*rows, strict=True)
    ]
    lines = [tags("th", columns, worded), *(tags("td", row, worded) for row in rows)]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table>{body}</table></div>'


def tags(tag: str, values: Sequence[object], worded: Sequence[bool]) -> str:
    """The cells of one line."""
    kinds = (' class="text"' if words else "" for words in worded)
    return "".join(
        f"<{tag}{kind}>{html.escape(shown(value))}</{tag}>" for kind, value in zip(kinds, values, strict=True)
    )
