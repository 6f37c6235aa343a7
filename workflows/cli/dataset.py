"""`gnmreg dataset describe`: who is in a dataset, and what they do."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.errors import InputError
from workflows.cli.options import NOT_SET

_NAMED = 8  # on the terminal, of those that lack a tag; page and CSV name all


def describe(
    dataset: Positional[Annotated[Path, arg(metavar="DATASET")]],
    /,
    out: Annotated[Path | None, arg(metavar="HTML", help_behavior_hint=NOT_SET)] = None,
) -> int:
    """Count a dataset's subjects and samples by their tags.

    Tags are gender, age, ethnicity, and the category of the expression.

    Only headers are read. Subjects and captures that lack a tag are named, all of them in the files.

    Args:
        dataset: A folder of subject folders with captures.
        out: Page to write; a CSV file of the same name is written beside it.
    """
    from registration.storage.files import atomic_write_text, check_output_file
    from workflows.pages.dataset import render_dataset_page
    from workflows.records.dataset import read_dataset
    from workflows.records.dataset_figures import NOT_STATED, csv_text
    from workflows.records.dataset_figures import describe as count

    if out is not None:
        if out.suffix.lower() != ".html":
            raise InputError(
                "The name of the page does not end in .html",
                where="out",
                expected="a file name that ends in .html",
                got=out.name,
                fix="add .html: the CSV file takes its name from it",
            )
        for file in (out, out.with_suffix(".csv")):
            check_output_file(file)
    figures = count(read_dataset(dataset))
    print(f"{figures.subjects} subjects, {figures.samples} samples, {len(figures.expressions)} expression labels")
    for each in figures.distributions:
        groups = [f"{group.group} {group.subjects} ({group.samples})" for group in each.groups if group.samples]
        if each.missing:
            more = f" and {len(each.missing) - _NAMED} more" if len(each.missing) > _NAMED else ""
            groups.append(f"{NOT_STATED}: {', '.join(each.missing[:_NAMED])}{more}")
        print(f"{each.kind}, subjects (samples): {'; '.join(groups)}")
    if empty := figures.empty_categories:
        print(f"categories without a sample: {', '.join(empty)}")
    for name, reason in figures.unreadable.items():
        print(f"not counted: {name}: {reason}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(out, render_dataset_page(figures))
        atomic_write_text(out.with_suffix(".csv"), csv_text(figures))
        print(out)
    return 0
