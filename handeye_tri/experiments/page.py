"""All figures and tables on one page that needs nothing beside it."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Sequence
from pathlib import Path

from handeye_tri.experiments.outcome import Outcome
from handeye_tri.storage import write_bytes

# A longer table is only linked to.
_LONGEST_TABLE = 40

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The paper's experiments</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto;
  padding: 0 1rem; color: #1c1c1c; background: #fff; }
img { display: block; width: 100%; min-width: 44rem; height: auto; }
/* Wider than a phone: moved by the finger, not shrunk until nobody can read it. */
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.verdict { padding: .4rem .8rem; border-left: .4rem solid #888; background: #f5f5f5; }
.PASS { border-color: #2e7d32; } .FAIL { border-color: #c62828; }
h2 { margin-top: 3rem; }
@media (max-width: 40rem) { h1 { font-size: 1.5rem; } h2 { font-size: 1.2rem; } }
</style>
</head>
<body>
<h1>The paper's experiments</h1>
<p>Zhao, Liu and Zhang, Camera calibration with three noncollinear points under special
motions (2008), Sec. IV, done again with bounds on what any estimate can reach.</p>
<table>
<tr><th>experiment</th><th>verdict</th></tr>
{% for outcome in outcomes %}<tr>
<td><a href="#{{ outcome.name }}">{{ outcome.title }}</a></td>
<td>{{ outcome.verdict }}</td></tr>
{% endfor %}</table>
{% for outcome in outcomes %}
<h2 id="{{ outcome.name }}">{{ outcome.title }}</h2>
<p class="verdict {{ outcome.verdict }}"><strong>{{ outcome.verdict }}.</strong>
{{ outcome.sentence }}</p>
<div class="wide"><img alt="{{ outcome.title }}" src="{{ pictures[loop.index0] }}">
</div>
{% set table = tables[loop.index0] %}
{% if table|length <= longest %}<div class="wide"><table>
{% for line in table %}<tr>{% for cell in line %}
<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table></div>
{% else %}<p>{{ table|length - 1 }} rows in {{ outcome.files[0].name }}.</p>{% endif %}
{% if outcome.files|length > 4 %}<p>To look at: {{ outcome.files[4].name }}
(<code>rerun {{ outcome.files[4].name }}</code>).</p>{% endif %}
{% endfor %}
</body>
</html>
"""


def write_page(folder: Path, outcomes: Sequence[Outcome]) -> Path:
    """Write index.html with every verdict, plot and short table; returns its path.

    Args:
        folder: Where to.
        outcomes: In order.
    """
    from jinja2 import Environment

    pictures, tables = [], []
    for outcome in outcomes:
        table, drawing = outcome.files[:2]
        encoded = base64.b64encode(drawing.read_bytes()).decode()
        pictures.append(f"data:image/svg+xml;base64,{encoded}")
        lines = list(csv.reader(io.StringIO(table.read_text())))
        tables.append([[_short(cell) for cell in line] for line in lines])
    text = (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            outcomes=outcomes,
            pictures=pictures,
            tables=tables,
            longest=_LONGEST_TABLE,
        )
    )
    path = folder / "index.html"
    write_bytes(path, text.encode())
    return path


def _short(cell: str) -> str:
    """A number to five digits; other text as it is."""
    try:
        return f"{float(cell):.5g}" if "." in cell else cell
    except ValueError:
        return cell
