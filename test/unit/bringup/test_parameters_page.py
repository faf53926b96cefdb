"""The page of parameters is what the nodes have."""

from pathlib import Path

from knee_gap_bringup.parameters_page import page

PAGE = Path(__file__).parents[3] / "docs" / "how" / "parameters.md"


def test_page_in_the_docs_is_the_one_that_is_printed() -> None:
    assert PAGE.read_text().splitlines() == list(page())


def test_every_parameter_says_what_it_means() -> None:
    rows = [line for line in page() if line.startswith("| `")]
    assert len(rows) > 40
    assert not [row for row in rows if row.rstrip(" |").endswith("|") or row.split("|")[4].strip() == ""]
