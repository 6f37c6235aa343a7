"""The verdicts of the gate's rules, and what thresholds may be."""

from dataclasses import replace
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.storage.registration_folder import read_manifest
from tests.workflows.gate import made
from workflows.gate.figures import FIGURES, Assessed, GateFigures, assess, read_figures
from workflows.gate.rules import GateThresholds, Limit, is_sampled, judge

QUIET = GateThresholds(sample_share=0.0)


def assessed(content_id: str = "a", **figures: object) -> Assessed:
    values = read_figures(figures or made.figures())
    return Assessed(content_id=content_id, status="converged", reason="", is_neutral=True, figures=values)


def test_what_lies_within_all_limits_is_accepted():
    verdict = judge(assessed(), QUIET)
    assert verdict.level == "accept" and not verdict.reasons and not verdict.for_person
    assert verdict.unmeasured == ("scan_mm", "far_landmarks_percent", "depth_mm")  # stated, and no reason by themselves


def test_a_reason_names_figure_value_limit_and_unit():
    (reason,) = judge(assessed(**made.figures(landmarks_px=7.0)), QUIET).reasons
    assert (reason.level, reason.figure, reason.value, reason.limit, reason.unit) == (
        "look",
        "landmarks_px",
        7,
        5,
        "px",
    )
    assert reason.text == "landmarks 7.0 px (limit 5.0 px)"


def test_the_worst_level_counts_and_comes_first():
    verdict = judge(assessed(**made.figures(landmarks_px=7.0, normals_deg=50.0, silhouette_px=14.0)), QUIET)
    assert verdict.level == "reject"
    levels = [(reason.level, reason.figure) for reason in verdict.reasons]
    assert levels[0] == ("reject", "normals_deg")
    assert ("look", "silhouette_px") in levels and ("look", "landmarks_px") in levels
    assert levels.index(("look", "silhouette_px")) < levels.index(("look", "landmarks_px"))


def test_one_bad_view_is_seen_though_the_others_are_good():
    verdict = judge(assessed(**made.figures("silhouette_px", 30.0)), QUIET)
    assert [reason.figure for reason in verdict.reasons] == ["worst_silhouette_px"]


@pytest.mark.parametrize(("status", "level"), [("failed", "reject"), ("stopped", "look")])
def test_the_status_counts(status, level):
    assert judge(replace(assessed(), status=status), QUIET).level == level
    tolerant = replace(QUIET, stopped="accept")
    assert judge(replace(assessed(), status=status), tolerant).level == {"look": "accept"}.get(level, level)


def test_without_evidence_nothing_is_accepted():
    verdict = judge(assessed(motion_mm=0.01), QUIET)
    assert verdict.level == "look"
    assert [reason.text for reason in verdict.reasons] == [
        "nothing measures the surface",
        "nothing measures the outline",
        "nothing measures the position of the face's parts",
    ]


def test_a_neutral_has_no_figures_of_its_neutral(tmp_path):
    neutral = assessed()
    assert "neutral_texture" not in judge(neutral, QUIET).unmeasured
    assert "neutral_texture" in judge(replace(neutral, is_neutral=False), QUIET).unmeasured


def test_figures_are_read_from_a_manifest(tmp_path):
    values = made.figures("labels_percent", 4.0)
    values |= {"views_not_trusted": {"cam1": "it disagrees"}, "warnings": ["one"]}
    values |= {"scan_to_mesh": {"face": {"mean_mm": 0.25}}, "from_neutral": {"offsets_mm": 0.3, "texture": 0.1}}
    values |= {"reversed_skin": {"area_mm2": 2.5, "places": {}}}
    values["intersections"]["pairs"]["tongue in teeth"] = {"max_excess_mm": 9.0, "vertices_beyond_0.3mm": 90}
    read = assess(read_manifest(made.write(tmp_path / "r", **values))).figures
    assert (read.worst_labels_percent, read.labels_percent, read.scan_mm) == (8.0, 2.0, 0.25)
    assert (read.untrusted_percent, read.warnings, read.neutral_offsets_mm) == (25.0, 1.0, 0.3)
    assert (read.intersections_mm, read.intersecting_vertices, read.neutral_texture) == (0.4, 2.0, 0.1)
    assert read.reversed_skin_mm2 == 2.5


@pytest.mark.parametrize("value", ["3", None, float("nan"), True, [1.0], {"a": 1}])
def test_what_is_no_number_is_not_measured(value):
    values = made.figures()
    values["residuals"]["overall"]["normals_deg"] = value
    values["from_model"]["offset_sigmas"] = value
    read = read_figures(values)
    assert read.normals_deg is None and read.offset_sigmas is None and read.colour_levels == 4.0


def test_every_figure_has_a_limit_and_a_description():
    assert list(GateThresholds().limits) == list(FIGURES) == list(vars(GateFigures()))


def test_the_sample_of_the_accepted_is_the_share_and_the_same_every_time():
    thresholds = GateThresholds(sample_share=0.2)
    chosen = [name for name in map(str, range(2000)) if is_sampled(name, thresholds)]
    assert 320 <= len(chosen) <= 480
    assert chosen == [name for name in map(str, range(2000)) if is_sampled(name, thresholds)]
    assert chosen != [name for name in map(str, range(2000)) if is_sampled(name, replace(thresholds, seed=1))]
    assert set(chosen) <= {n for n in map(str, range(2000)) if is_sampled(n, replace(thresholds, sample_share=0.3))}
    verdict = judge(assessed(chosen[0]), thresholds)
    assert verdict.level == "accept" and verdict.for_person


def test_thresholds_are_saved_and_their_id_is_that_of_what_decides(tmp_path):
    thresholds = GateThresholds(normals_deg=Limit(look=3.5))
    thresholds.write(tmp_path / "t.json")
    read = GateThresholds.read(tmp_path / "t.json")
    assert read == thresholds and read.content_id == thresholds.content_id
    assert replace(read, name="studio").content_id == read.content_id
    assert replace(read, seed=1).content_id != read.content_id != GateThresholds().content_id


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('"sample_share": 1.5', "sample_share"),
        ('"normals_deg": {"look": 3.0, "reject": 2.0}', "normals_deg"),
        ('"normals_deg": {"looks": 3.0}', "normals_deg"),
        ('"normals_degrees": {"look": 3.0}', "normals_degrees"),
        ('"seed": -1', "seed"),
    ],
)
def test_thresholds_that_make_no_sense_are_refused(tmp_path: Path, text: str, field: str):
    (tmp_path / "t.json").write_text(f'{{"kind": "gnm-gate-thresholds", "schema": 1, {text}}}')
    with pytest.raises(InputError) as error:
        GateThresholds.read(tmp_path / "t.json")
    assert field in error.value.where
