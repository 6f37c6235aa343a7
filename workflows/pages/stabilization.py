"""The HTML page of a stabilized set: self-contained."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from registration.report.charts import loss_curves
from registration.report.heat_map import UNMEASURED, heat_pictures
from registration.report.inputs import HeatMap
from registration.report.pictures import SCALE, data_uri
from registration.report.style import document
from registration.stabilize.components import Components, Head
from registration.stabilize.pipeline import StabilizedSubject

LIMIT_MM = 2.0  # at the end of the map's colours
_PICTURED = 12  # subjects; a page of hundreds would not open


def write_stabilize_page(
    manifest: Mapping[str, Any], components: Sequence[Components], subjects: Iterable[StabilizedSubject], head: Head
) -> str:
    """Maps and residuals of the first subjects, and all components with their scores."""
    figures = manifest["figures"]
    tiles = (
        (f"{figures['samples']}", f"expressions of {len(manifest['subjects'])} subjects"),
        (f"{figures['residual_median_mm']:.2f} <small>mm</small>", "skin on the skull from the neutral, median"),
        (f"{figures['regional_turn_deg']:.2f} <small>°</small>", "turned by the second stage, rms"),
        (f"{figures['regional_rms_mm']:.2f} <small>mm</small>", "moved by the second stage, rms"),
    )
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles)
    cards, settings = [], manifest["config"].automatic
    for number, subject in enumerate(subjects):
        if number == _PICTURED:
            break
        cards.append(_subject(subject, head, settings.still_mm))
    more = len(manifest["subjects"]) - len(cards)
    rest = f'<p class="hint">And {more} more subjects, not pictured.</p>' if more > 0 else ""
    body = (
        '<header><div class="top"><div class="eyebrow">Stabilization</div><h1>The skull stands still</h1>'
        f'<p class="lead">Dataset <span class="mono">{escape(manifest["dataset"][:16])}</span></p>'
        f'<div class="tiles">{cells}</div></div></header><main>'
        "<h2>What stays with the skull</h2><p>Median distance of the skin from the neutral over a subject's "
        "expressions, once these are aligned: what is steady is trusted. Curves: the distance after each round, "
        f"weighted as in the last.</p>{_bar()}{''.join(cards)}{rest}<h2>Components</h2><p>Of each region, what 99 % of "
        "its motion is made of. Flagged is what looks like motion of the whole head: rigid, whatever the expression, "
        "shared by nose and neck.</p>"
        f'<div class="panel">{_table(components, head)}</div><footer></footer></main>'
    )
    return document("Stabilized expressions", body)


def _subject(subject: StabilizedSubject, head: Head, still_mm: float) -> str:
    trust = subject.confidence_map.astype(np.float64)
    distance = np.where(trust > 0, still_mm * np.sqrt(1 / np.maximum(trust, 1e-9) - 1), np.nan)
    heat = HeatMap(
        vertices=subject.neutral, triangles=head.data.triangles, distance_mm=distance, T_head_world=subject.T_head_world
    )
    sides = "".join(
        f'<figure><img class="zoom" alt="{escape(subject.subject)}, {side}" src="{data_uri(picture)}"></figure>'
        for side, picture in heat_pictures(heat, LIMIT_MM)
    )
    residual = subject.residual_mm
    curves = {"median": np.median(residual, 0).tolist(), "worst": residual.max(0).tolist()}
    return (
        f'<div class="panel" style="margin-top:16px"><h3 style="margin:0 0 10px">{escape(subject.subject)} '
        f'<span class="chips">{len(subject.names)} expressions</span></h3><div class="sides">{sides}</div>'
        f"{loss_curves({'distance, mm': curves})}</div>"
    )


def _bar() -> str:
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    return (
        f'<div class="bar"><span>0 mm</span><i style="background:linear-gradient(90deg, {stops})"></i>'
        f'<span>{LIMIT_MM:g} mm and more</span><em><span class="swatch" style="background:rgb{UNMEASURED}"></span>'
        "has no say: unseen, neck, mouth and cheeks</em></div>"
    )


def _table(components: Sequence[Components], head: Head) -> str:
    heads = ("energy", "S", "S1 rigid", "S3 free of label", "S5 shared", "turn, °", "moves, mm")
    rows = []
    for part in components:
        moves = part.rigid_rms_mm(head)
        turns = np.degrees(np.linalg.norm(part.twists[:, :3], axis=1))
        for k in range(len(part.energy)):
            values = (part.score[k], part.rigid_share[k], part.free_of_label[k], part.shared[k], turns[k], moves[k])
            numbers = "".join(f'<td class="num">{value:.2f}</td>' for value in values)
            flag = '<span class="badge stopped">flagged</span>' if part.flagged[k] else ""
            rows.append(
                f"<tr><td>{part.region.replace('_', ' ')}</td><td>{k + 1}{flag}</td>"
                f'<td class="num">{100 * part.energy[k]:.1f} %</td>{numbers}</tr>'
            )
    titles = "".join(f'<th class="num">{name}</th>' for name in heads)
    return f"<table><tr><th>region</th><th>component</th>{titles}</tr>{''.join(rows)}</table>"
