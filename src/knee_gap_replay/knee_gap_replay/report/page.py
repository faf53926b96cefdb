"""The pages of a report: HTML that needs no network, with its figures and pictures inside."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from knee_gap_core.values.gap_estimate import GapStatus
from knee_gap_replay.report import figures
from knee_gap_replay.report.frames import Frame
from knee_gap_replay.report.results import Floats, Results, status_name
from knee_gap_uncertainty.estimation.messages import SHARES

MOST_DROPOUTS = 40
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1040px; margin: 2em auto; }
body { padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0.2em; } h2 { font-size: 1.15em; margin-top: 1.8em; }
table { border-collapse: collapse; margin: 0.6em 0; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 0.2em 0.9em 0.2em 0; }
th, td { border-bottom: 1px solid #e3e3e3; }
th { font-weight: 600; border-bottom-color: #999; } td.number, th.number { text-align: right; }
.facts td:first-child { color: #666; white-space: nowrap; } .flaw { color: #b3261e; } .note { color: #666; }
.frames { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1em; }
figure { margin: 0; } figure img { width: 100%; display: block; }
figcaption { font-size: 0.87em; color: #444; }
svg { max-width: 100%; height: auto; }
""".strip()


class Content(NamedTuple):
    """What the page of one bag shows; `truth` has one entry per estimate [m], NaN where it is not known."""

    name: str
    results: Results
    truth: Floats
    truth_note: str
    frames: Sequence[Frame]
    frames_note: str


class Scores(NamedTuple):
    """Estimates beside the truth: how many, median |gap - truth| [m], fractions with the truth inside."""

    known: int
    error: float
    in_bounds: float
    in_interval: float


def scores(content: Content) -> Scores | None:
    """Scores of the VALID estimates whose truth is known; None if there is none."""
    numbers, truth = content.results.numbers, content.truth
    known = content.results.valid & np.isfinite(truth)
    if not known.any():
        return None
    at = truth[known]

    def share(low: str, high: str) -> float:
        return float(np.mean((numbers[low][known] <= at) & (at <= numbers[high][known])))

    return Scores(
        int(known.sum()),
        float(np.median(np.abs(numbers["gap"][known] - at))),
        share("gap_min", "gap_max"),
        share("confidence_min", "confidence_max"),
    )


def bag_page(content: Content) -> str:
    """The page of one bag."""
    results = content.results
    parts = [
        f"<h1>{escape(content.name)}</h1>",
        f'<p class="note">{escape(str(results.path))} &middot; <a href="{escape(content.name)}.csv">all '
        'numbers as CSV</a> &middot; <a href="index.html">all bags</a></p>',
        *(f'<p class="flaw">{escape(remark)}</p>' for remark in results.remarks),
        _facts(content),
        "<h2>Gap over time</h2>",
        figures.over_time(results, content.truth),
        '<p class="note">Bands: worst-case bounds, and the confidence interval of all views. The strip '
        "is the status of every image. Below: signal-to-noise ratio, and (dotted) the baseline, the "
        "distance of the lens from its first position in the track.</p>",
        "<h2>Error budget</h2>",
        _budget(results),
        "<h2>Status and reasons</h2>",
        _table(
            ("status", "reason", "estimates#", "share#"),
            (
                (status, reason or "-", count, _percent(count / len(results.status)))
                for status, reason, count in results.causes()
            ),
        ),
        _edge_statuses(results),
        "<h2>Drop-outs</h2>",
        _dropouts(results),
        "<h2>Frames</h2>",
        _frames(content),
        "<h2>Calibration used</h2>",
        _calibrations(results),
    ]
    return _page(content.name, parts)


def index_page(contents: Sequence[Content], failed: Sequence[tuple[str, str]]) -> str:
    """The page over all bags; `failed` are paths that could not be reported, and why."""
    parts = [f"<h1>{len(contents)} bags</h1>" if len(contents) != 1 else "<h1>1 bag</h1>"]
    if failed:
        parts.append(_table(("not reported", "reason"), failed).replace("<table>", '<table class="flaw">', 1))
    if contents:
        parts += [
            _table(INDEX_COLUMNS, (index_row(one) for one in contents), links=True),
            '<p class="note">Medians are over the VALID estimates. Error and inside: |gap - truth| and the '
            "fraction of estimates whose bounds hold the truth, for simulated bags.</p>",
            figures.all_bags([one.name for one in contents], [(one.results, one.truth) for one in contents]),
        ]
    return _page("knee_gap report", parts)


INDEX_COLUMNS = (
    "bag",
    "duration [s]#",
    "estimates#",
    "VALID#",
    "gap [mm]#",
    "[min, max] [mm]#",
    "SNR#",
    "drop-outs#",
    "longest [s]#",
    "error [mm]#",
    "inside#",
)


def index_row(content: Content) -> tuple[object, ...]:
    """One bag in the table over all, with the columns of INDEX_COLUMNS."""
    results, numbers, scored = content.results, content.results.numbers, scores(content)
    dropouts = results.dropouts()
    low, high = (results.median(numbers[name]) for name in ("gap_min", "gap_max"))
    return (
        content.name,
        f"{results.duration:.1f}",
        len(results.status),
        _percent(results.valid_share),
        _mm(results.median(numbers["gap"])),
        f"{_mm(low)} - {_mm(high)}",
        _number(results.median(numbers["snr"]), 1),
        len(dropouts),
        _number(max((one.end - one.begin for one in dropouts), default=0.0), 2),
        _mm(scored.error) if scored else "-",
        _percent(scored.in_bounds) if scored else "-",
    )


def _facts(content: Content) -> str:
    results, numbers, scored = content.results, content.results.numbers, scores(content)
    low, high = (results.median(numbers[name]) for name in ("gap_min", "gap_max"))
    rows = [
        ("duration", f"{results.duration:.2f} s, {len(results.status)} estimates"),
        ("VALID", f"{int(results.valid.sum())} ({_percent(results.valid_share)})"),
        ("tracks", str(len(set(results.track_ids.tolist()) - {0}))),
        ("median gap", f"{_mm(results.median(numbers['gap']))} mm, bounds {_mm(low)} to {_mm(high)} mm"),
        ("median SNR", _number(results.median(numbers["snr"]), 2)),
    ]
    if scored:
        rows.append(
            (
                "truth",
                f"median |gap - truth| {_mm(scored.error)} mm; inside the bounds "
                f"{_percent(scored.in_bounds)}, inside the interval {_percent(scored.in_interval)} of "
                f"{scored.known} VALID estimates whose truth was computed",
            )
        )
    elif content.truth_note:
        rows.append(("truth", content.truth_note))
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows)
    return f'<table class="facts">{cells}</table>'


def _budget(results: Results) -> str:
    drawn = figures.error_budget(results)
    if not drawn:
        return '<p class="note">No estimate has the shares of its variance.</p>'
    shares = [(name, results.median(results.numbers[name])) for name in SHARES]
    return drawn + _table(
        ("cause", "median share#"),
        ((name.removeprefix("share_").replace("_", " "), _percent(share)) for name, share in shares),
    )


def _edge_statuses(results: Results) -> str:
    if not results.edge_statuses:
        return ""
    return "<h3>Edges in the images</h3>" + _table(
        ("status of gap_edges", "images#"), results.edge_statuses.most_common()
    )


def _dropouts(results: Results) -> str:
    found = results.dropouts()
    streams = _table(
        ("topic", "messages#", "rate [Hz]#", "pauses#", "longest [s]#"),
        (
            (one.name, one.messages, _number(one.rate, 1), one.pauses, _number(one.longest, 3))
            for one in results.streams
        ),
    )
    if not found:
        return "<p>Every estimate is VALID.</p>" + streams
    shown = sorted(sorted(found, key=lambda one: one.begin - one.end)[:MOST_DROPOUTS])
    note = (
        f'<p class="note">The {MOST_DROPOUTS} longest of {len(found)}.</p>'
        if len(found) > len(shown)
        else f"<p>{len(found)} times without a VALID estimate.</p>"
    )
    rows = (
        (f"{one.begin:.2f}", f"{one.end - one.begin:.2f}", one.images, one.status, one.reason or "-")
        for one in shown
    )
    columns = ("begin [s]#", "duration [s]#", "estimates#", "status", "most frequent reason")
    return note + _table(columns, rows) + "<h3>Messages</h3>" + streams


def _frames(content: Content) -> str:
    if not content.frames:
        return f'<p class="note">{escape(content.frames_note)}</p>'
    places = {int(stamp): index for index, stamp in enumerate(content.results.stamps_ns)}
    drawn = [_frame(content, frame, places.get(frame.stamp_ns)) for frame in content.frames]
    legend = "Crosses: the two tracked points. Circle: between the two edges at the section."
    return f'<div class="frames">{"".join(drawn)}</div><p class="note">{legend}</p>'


def _frame(content: Content, frame: Frame, index: int | None) -> str:
    results, caption = content.results, ""
    if index is not None:
        status = int(results.status[index])
        caption = f"{results.time[index]:.2f} s, {status_name(status)}"
        if status == GapStatus.VALID:
            gap, low, high = (results.numbers[name][index] for name in ("gap", "gap_min", "gap_max"))
            caption += f": {_mm(gap)} mm, {_mm(low)} to {_mm(high)} mm"
        elif results.reasons[index]:
            caption += f": {results.reasons[index]}"
    if not frame.jpeg:
        return f'<p class="flaw">{escape(caption)}: {escape(frame.flaw)}</p>'
    data = base64.b64encode(frame.jpeg).decode()
    text = escape(caption)
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" alt="{text}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _calibrations(results: Results) -> str:
    if not results.calibrations:
        return (
            '<p class="note">No scope_calibration in the bag: the nodes had no calibration file, or it was '
            "not recorded.</p>"
        )
    return _table(
        ("node", "hash", "image [px]", "lens: shift [mm]#", "rotation [deg]#", "time offset [ms]#"),
        (_calibration(one) for one in results.calibrations),
    )


def _calibration(message: Any) -> tuple[str, ...]:
    if not message.hash:
        return (str(message.node), "no calibration file", "-", "-", "-", "-")
    variances = np.array(message.lens_covariance, dtype=float).reshape(6, 6).diagonal()
    # Standard errors, as RMS lengths of the vectors.
    shift = float(np.sqrt(max(variances[:3].sum(), 0.0))) if np.isfinite(variances).all() else float("nan")
    turn = float(np.sqrt(max(variances[3:].sum(), 0.0))) if np.isfinite(variances).all() else float("nan")
    offset, error = 1e3 * float(message.time_offset), 1e3 * float(message.time_offset_error)
    return (
        str(message.node),
        str(message.hash)[:16],
        f"{message.width_px} x {message.height_px}",
        _number(1e3 * shift, 4),
        _number(float(np.degrees(turn)), 4),
        f"{offset:.3f} +- {error:.3f}" if np.isfinite(offset) else "-",
    )


def _table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, links: bool = False) -> str:
    """A table; a column whose name ends with # holds numbers. `links`: the first column names pages."""
    kinds = [' class="number"' if name.endswith("#") else "" for name in columns]
    names = "".join(
        f"<th{kind}>{escape(name.rstrip('#'))}</th>" for name, kind in zip(columns, kinds, strict=True)
    )
    lines = []
    for row in rows:
        cells = [escape(str(value)) for value in row]
        if links:
            cells[0] = f'<a href="{cells[0]}.html">{cells[0]}</a>'
        lines.append("".join(f"<td{kind}>{cell}</td>" for cell, kind in zip(cells, kinds, strict=True)))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>"


def _page(title: str, parts: Sequence[str]) -> str:
    body = "\n".join(part for part in parts if part)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>\n{_STYLE}\n</style>\n</head>\n'
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _mm(length: float) -> str:
    return _number(1e3 * length, 2)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if np.isfinite(share) else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
