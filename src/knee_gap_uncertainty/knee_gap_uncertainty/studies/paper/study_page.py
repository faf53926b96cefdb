"""The text of the study's page: what was done, what came of it, and what to look at in each picture."""

from collections.abc import Mapping
from pathlib import Path

from knee_gap_uncertainty.studies.paper.geometry import Fit
from knee_gap_uncertainty.studies.paper.geometry_fit import differences_mm
from knee_gap_uncertainty.studies.paper.report import heading, page, paragraph, picture, table
from knee_gap_uncertainty.studies.paper.table_4 import Row
from knee_gap_uncertainty.studies.paper.tables import Table

TITLE = "How wide is the instrument gap? The paper's simulation study, done again"

LEAD = """A gap of 4 mm inside the knee is seen twice by one lens that moves 2 or 8 mm between. How wide may
it be? The paper answers with a cloud of possible places about each end of the gap. Here are its
tables and figures, computed again from its own parameters, beside a worst case that admits every
sign its equations name."""

CAPTIONS = {
    "table_4": """Ranges of the gap as published, ours by the same reading, and the worst case. The true
    gap is 4 mm.""",
    "runs": """Error of the measured gap in simulated runs, errors drawn evenly within their bounds.
    The amber band is the published mean with three published standard deviations; errors of
    this size spread the gap far wider. What lies beyond the axes is counted at their ends.""",
    "figure_9a": """Clouds about both ends of the gap, seen in the plane of the lens and the gap. Full
    colour: the paper's reading. Pale: the worst case, in clumps, one for each pair of
    signs; the shaded body holds what lies between them. Black: the smallest and the largest
    gap between points of the full clouds. What of the travel lies out of this plane does
    not show.""",
    "figure_9b": """What remains of a ray's length, equation (12), for every combination of displaced
    lenses, in order. Left: errors of position alone. Right: with the angular error in (17)
    and (18). Dots: the paper's linear form (11), which follows the exact one neither in
    size nor always in sign.""",
    "figure_10": "(a) to (c): average errors. (d): the largest errors measured. Drawn as figure 9.",
    "figure_11": """The largest errors at 45 degrees. A longer travel shortens the clouds along the rays; it
    does not narrow them across.""",
    "figure_12": """Above: the gap over the width of its range. Below: the range itself, by the better of
    both lenses. Below a certain travel nothing bounds the gap in the worst case; beyond a
    few millimetres more travel helps little and can harm.""",
    "sensitivity": """RMS difference to rows 1 to 5 of Table 4 as one number of the place changes and the
    others stay. The places in the table above are quite different and fit almost as well:
    Table 4 does not show where the gap was.""",
}


def study_page(pictures: Mapping[str, Path], tables: Mapping[str, Table], fit: Fit, rows: list[Row]) -> str:
    """The page; `pictures` and `tables` by the names of their files."""

    def shown(name: str) -> str:
        return picture(pictures[name], " ".join(CAPTIONS[name].split()))

    return page(
        TITLE,
        [
            f"<h1>{TITLE}</h1>",
            paragraph(" ".join(LEAD.split()), "lead"),
            paragraph(held_words(rows)),
            heading("Table 4: ranges of the gap"),
            shown("table_4"),
            paragraph(fit_words(fit)),
            table(*tables["table_4"]),
            heading("The simulated runs"),
            shown("runs"),
            table(*tables["runs"]),
            heading("Figure 9: clouds and length errors at 0 degrees"),
            shown("figure_9a"),
            shown("figure_9b"),
            heading("Figure 10: clouds at 30, 45 and 90 degrees"),
            shown("figure_10"),
            heading("Figure 11: 2 mm against 8 mm of travel"),
            shown("figure_11"),
            heading("Figure 12: signal-to-noise ratio against travel"),
            shown("figure_12"),
            heading("Where the gap lies"),
            table(*tables["geometry"]),
            shown("sensitivity"),
            heading("Table 3: parameters"),
            table(*tables["table_3"]),
            heading("The paper's own arithmetic"),
            table(*tables["consistency"]),
        ],
    )


def held_words(rows: list[Row]) -> str:
    """How often the ranges held the true gap."""
    paper = [100 * row.runs.held_paper for row in rows]
    worst = [100 * row.runs.held_worst_case for row in rows]
    runs = sum(len(row.runs.errors_mm) for row in rows)
    return (
        f"In {runs} simulated measurements with errors within the stated bounds, the paper's range held the "
        f"true gap in {min(paper):.0f} to {max(paper):.0f} %, depending on the scenario; the worst case in "
        f"{min(worst):.1f} to {max(worst):.1f} %."
    )


def fit_words(fit: Fit) -> str:
    """Where our cells come from."""
    farthest = abs(differences_mm(fit.place, fit.apex)).max()
    return (
        "The paper does not say where its gap lies. Ours is the place that fits rows 1 to 5 best by the "
        f"paper's own words: RMS {fit.rms_mm:.3f} mm, largest difference {farthest:.3f} mm. Row 6 follows "
        "from the same place and was not fitted. Mean and standard deviation are of the simulated runs."
    )
