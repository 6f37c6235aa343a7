"""The HTML page of a dataset: self-contained."""

from workflows.pages.base import render
from workflows.records.dataset_figures import DatasetFigures


def render_dataset_page(figures: DatasetFigures) -> str:
    """Return the page: tiles, a distribution for each tag and for the categories, and what is not stated."""
    tiles = [
        (f"{figures.subjects:,}", "", "subjects"),
        (f"{figures.samples:,}", "", "samples: captures, neutrals included"),
        (f"{len(figures.expressions):,}", "", "expression labels"),
        (f"{len(figures.empty_categories)}", "of 10", "categories without a sample"),
    ]
    most = {each.kind: max((g.samples for g in each.groups), default=1) or 1 for each in figures.distributions}
    return render("dataset.html", figures=figures, tiles=tiles, most=most)
