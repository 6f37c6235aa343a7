"""The verdict follows from the figures, whatever the status says."""

from typing import Any

import pytest

from registration.evaluate.names import LEVEL_TITLES
from registration.evaluate.residuals import residual_figures
from registration.evaluate.verdict import judge


def scan(median: float, mean: float, p95: float) -> dict[str, Any]:
    return {"scan_to_mesh": {"face": {"points": 9, "median_mm": median, "mean_mm": mean, "p95_mm": p95}}}


def residuals(**values: float) -> dict[str, Any]:
    usual = {"silhouette_px": 0.2, "normals_deg": 0.5, "colour_levels": 1.0, "labels_percent": 1.0, "landmarks_px": 0.4}
    return {"residuals": residual_figures({name: {**usual, **values} for name in ("cam00", "cam01", "cam02")})}


@pytest.mark.parametrize(
    ("figures", "level", "reason"),
    [
        (scan(0.05, 0.10, 0.28), "good", "0.10 mm from the mesh on average"),
        (scan(0.08, 0.29, 1.53), "good", "0.29 mm"),  # an open mouth
        (scan(0.06, 0.10, 2.50), "look", "5 % of the scan's face lie more than 2.5 mm"),
        (scan(0.30, 0.35, 1.00), "look", "half of the scan's face"),
        (scan(0.50, 1.15, 2.50), "wrong", "1.15 mm from the mesh on average"),
        (residuals(), "good", "no scan; in the images silhouette"),
        (residuals(silhouette_px=8.0), "wrong", "silhouette 8.0"),
        (residuals(colour_levels=40.0), "look", "colour 40.0"),
        ({**scan(0.05, 0.1, 0.3), **residuals(normals_deg=30.0)}, "good", "0.10 mm"),  # the scan decides
        ({}, "look", "nothing measures the mesh"),
        ({"residuals": residual_figures({"a": {"silhouette_px": 0.5}})}, "look", "neither normals nor colours"),
        (scan(0.459, 0.828, 2.569), "wrong", "0.83 mm"),
        ({"scan_to_mesh": {"face": {"points": 0, "mean_mm": None}}}, "look", "nothing measures the mesh"),
    ],
)
def test_the_face_decides(figures: dict[str, Any], level: str, reason: str) -> None:
    verdict = judge("converged", figures)
    assert verdict.level == level and reason in verdict.reasons[0]


def test_good_distances_with_something_to_look_at() -> None:
    good = {**scan(0.05, 0.10, 0.28), **residuals()}
    assert judge("stopped", good).level == "look" and judge("failed", good).level == "wrong"
    suspect = judge("converged", {**good, "views_not_trusted": {"cam01": "silhouette 30 px off the other views"}})
    assert suspect.level == "look" and suspect.reasons == ("cam01 disagrees with the other views",)
    two = judge("converged", {**good, "views_not_trusted": {"cam01": "", "cam02": ""}})
    assert two.level == "wrong" and two.reasons == ("cam01, cam02 disagree with the other views",)
    pairs = {"lips in teeth": {"max_excess_mm": 3.2}, "lips in gums": {"max_excess_mm": 0.1}}
    inside = judge("converged", {**good, "intersections": {"pairs": pairs}})
    assert inside.level == "look" and "up to 3.2 mm inside one another (lips in teeth)" in inside.reasons[0]
    hidden = {"tongue in gums": {"max_excess_mm": 4.04}, "upper lip in lower lip": {"max_excess_mm": 1.56}}
    assert judge("converged", {**good, "intersections": {"pairs": hidden}}).level == "good"
    assert judge("converged", {**good, "warnings": ["masks: 40 % lost"]}).level == "look"


def test_the_worst_reasons_come_first_and_good_ones_are_left_out() -> None:
    verdict = judge("stopped", scan(0.3, 1.2, 2.5))
    assert verdict.level == "wrong" and "on average" in verdict.reasons[0]
    assert len(verdict.reasons) == 4 and "stopped" in " ".join(verdict.reasons)
    assert verdict.figure == {"level": "wrong", "reasons": list(verdict.reasons)}
    assert set(LEVEL_TITLES) == {"good", "look", "wrong"}


@pytest.mark.parametrize(
    ("made", "level", "reason"),
    [
        ({"channels": ["masks", "normals"], "coverage": 0.8}, "good", "masks, normals were made from the photographs"),
        ({"channels": ["masks", "normals"], "coverage": 0.3}, "look", "depths on 30% of the head only"),
        ({"channels": ["masks"]}, "good", "masks were made from the photographs"),
    ],
)
def test_made_channels_are_named_and_little_stereo_asks_for_a_look(made, level, reason):
    overall = {"silhouette_px": 0.4, "normals_deg": 0.9, "colour_levels": 1.0, "labels_percent": 0.3}
    verdict = judge("converged", {"residuals": {"overall": overall}, "made": made})
    assert verdict.level == level and any(reason in line for line in verdict.reasons)
