"""The page of a coregistration while its steps run."""

import os
from pathlib import Path

import pytest

from tests.workflows.rounds import MODEL, write_people
from workflows.farm.coregistration import start_coregistration
from workflows.farm.plan import RoundSettings, make_plan
from workflows.steps.coregistration_page import shown_on_page


@pytest.fixture
def out(capture: Path, tmp_path: Path) -> Path:
    dataset, out = write_people(capture, tmp_path / "dataset", 4), tmp_path / "out"
    start_coregistration(make_plan(dataset, MODEL, out, rounds=RoundSettings(components=(2,))))
    return out


def product(out: Path, name: str) -> dict[str, str]:
    (out / name).mkdir(parents=True, exist_ok=True)
    (out / name / "index.html").write_text("")
    return {"out": str(out / name)}


def page(out: Path) -> str:
    return (out / "index.html").read_text()


def test_the_page_shows_a_product_when_its_step_ends(out: Path) -> None:
    @shown_on_page()
    def build(*, out: str) -> dict[str, str]:
        return product(Path(out).parents[1], "it00/model")

    assert "it00/model/index.html" not in page(out)
    assert build(out=str(out / "it00" / "model")) == {"out": str(out / "it00" / "model")}
    assert "it00/model/index.html" in page(out)


def test_the_page_is_written_after_a_failure_too(out: Path) -> None:
    @shown_on_page()
    def register(*, out: str) -> dict[str, str]:
        product(Path(out).parents[3], "it00/registrations/p0")
        raise ValueError("it failed")

    with pytest.raises(ValueError, match="it failed"):
        register(out=str(out / "it00" / "registrations" / "p0" / "rest"))
    assert "it00/registrations/p0/index.html" in page(out)


def test_one_of_many_steps_leaves_a_page_of_a_moment_ago(out: Path) -> None:
    @shown_on_page(often=True)
    def register(*, out: str) -> dict[str, str]:
        return product(Path(out).parents[3], "it00/registrations/p0")

    arguments = {"out": str(out / "it00" / "registrations" / "p0" / "rest")}
    register(**arguments)
    assert "registrations/p0" not in page(out)
    os.utime(out / "index.html", (0, 0))
    register(**arguments)
    assert "registrations/p0" in page(out)


def test_a_page_that_cannot_be_written_costs_no_product(out: Path, tmp_path: Path) -> None:
    messages: list[str] = []

    class Recorder:
        def message(self, text: str) -> None:
            messages.append(text)

    @shown_on_page()
    def build(*, out: str, progress: object = None) -> dict[str, str]:
        return {}

    (out / "coregistration.json").write_text("{")
    assert build(out=str(out / "it00" / "model"), progress=Recorder()) == {}
    assert "coregistration.json" in messages[0]
    assert build(out=str(tmp_path / "elsewhere" / "model")) == {} and len(messages) == 1
