"""The HTML page of a built model: its components, variance, subjects and rejected registrations; self-contained."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from registration.frames import MM_PER_M
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.report.charts import ChartLine, line_charts
from registration.report.heat_map import scale_limit_mm
from registration.report.inputs import HeatMap
from workflows.pages.base import heat_images, render

SIGMAS = 2.0
IDENTITY, EXPRESSION = 4, 2  # components drawn, of the head and of each region
SIDES, SIZE = ("front", "subject's left"), (300, 325)  # of each image; px


def render_model_page(data: GNMData, manifest: Mapping[str, Any]) -> str:
    """Return the page: the first components at plus and minus two standard deviations, variance and tables."""
    curves, variance_rows = _variance(manifest)
    groups = {**manifest["demographics"], "category": manifest["categories"], "label": manifest["labels"]}
    return render(
        "model.html",
        manifest=manifest,
        sigmas=SIGMAS,
        tiles=_tiles(manifest),
        identity=_drawn(data, _identity(data)),
        expressions=_drawn(data, _expressions(data)),
        curves=Markup(curves),
        variance_rows=variance_rows,
        rejected_rows=[(row["name"], row["reason"]) for row in manifest["rejected"]],
        gate=_gate(manifest.get("gate")),
        groups=[(name, list(counts.items())) for name, counts in groups.items() if counts],
    )


def _gate(gate: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What the page says of the quality gate; None for a model that was built without one."""
    if gate is None:
        return None
    verdicts = gate["verdicts"]
    waiting = "until a person rejects them" if gate["policy"] == "auto" else "once a person has accepted them"
    tiles = [
        (str(gate["accepted"]), "", "registrations used"),
        (str(verdicts["accept"]), "", "accepted by the rules"),
        (str(verdicts["look"]), "", f"for a person: used {waiting}"),
        (str(verdicts["reject"]), "", "rejected by the rules"),
        (str(len(gate["decisions"])), "", "decided by a person"),
    ]
    decided = [
        (
            d["name"],
            d["decision"],
            d["who"],
            d["time"][:16].replace("T", " "),
            d["verdict"],
            d["reason"],
            d["content_id"][:12],
        )
        for d in gate["decisions"]
    ]
    facts = {name: gate[name] for name in ("policy", "thresholds_name", "thresholds", "accepted_id", "log_head")}
    return {"tiles": tiles, "left_out": list(gate["left_out"].items()), "decided": decided, "facts": facts}


def _tiles(manifest: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    identity = manifest["identity"]
    expressions = sum(subject["expressions"] for subject in manifest["subjects"])
    kept = f"{100 * identity['share_kept']:.1f} %"
    return [
        (str(len(manifest["subjects"])), "", "subjects"),
        (str(expressions), "", "expressions"),
        (str(identity["components"]), "", f"identity components, {kept} of the variance"),
        (str(len(manifest["rejected"])), "", "registrations excluded as outliers"),
        (f"{manifest['figures']['drift_mm']:.2f}", "mm", "drift of the template's skull"),
    ]


def _identity(data: GNMData) -> dict[str, Float[np.ndarray, "V 3"]]:
    """The first components that move the skin, by name."""
    moves = np.abs(data.vertex_identity_basis[:, regions.exterior(data)]).max((1, 2), initial=0) > 0
    chosen = np.flatnonzero(moves)[:IDENTITY].tolist()
    return {str(data.identity_names[k]): data.vertex_identity_basis[k] for k in chosen}


def _expressions(data: GNMData) -> dict[str, Float[np.ndarray, "V 3"]]:
    """The first components of each region, by name."""
    chosen = [k for members, _ in regions.expression_regions(data).values() for k in members[:EXPRESSION].tolist()]
    return {str(data.expression_names[k]): data.expression_basis[k] for k in chosen}


def _drawn(data: GNMData, components: Mapping[str, Float[np.ndarray, "V 3"]]) -> dict[str, Any]:
    """Images of each component at both ends, coloured by the vertices' displacement on one scale."""
    if not components:
        return {"pairs": [], "limit_mm": 0.0}
    skin = regions.exterior(data)
    sizes = {name: SIGMAS * MM_PER_M * np.linalg.norm(basis, axis=1) for name, basis in components.items()}
    limit = scale_limit_mm(np.concatenate([size[skin] for size in sizes.values()]))
    pairs = []
    for name, basis in components.items():
        pair = []
        for sign, sigmas in (("+", SIGMAS), ("−", -SIGMAS)):
            heat = HeatMap(
                vertices=(data.template_vertex_positions + sigmas * basis).astype(np.float32),
                triangles=data.triangles,
                distance_mm=sizes[name],
                T_head_world=np.eye(4),
            )
            images = heat_images(heat, limit, sides=SIDES, size=SIZE)
            pair.append({"name": f"{name}, {sign}{SIGMAS:g}", "images": images})
        pairs.append(pair)
    return {"pairs": pairs, "limit_mm": limit}


def _variance(manifest: Mapping[str, Any]) -> tuple[str, list[tuple[Any, ...]]]:
    """Return the chart of the cumulated variance as SVG, and the table's rows."""
    parts = {"identity": manifest["identity"]}
    if isinstance(manifest["expression"], Mapping):
        parts |= manifest["expression"]
    lines, rows = [], []
    for name, part in parts.items():
        variance = np.array(part["variance_mm2"], float)
        percent = 100 * part["share_kept"] * np.cumsum(variance) / max(variance.sum(), 1e-30)
        words = name.replace("_", " ")
        lines.append(ChartLine(name=words, x=range(1, len(percent) + 1), y=percent.tolist()))
        cells = (part["components"], f"{100 * part['share_kept']:.2f} %", f"{100 * part['share_previous']:.0f} %")
        rows.append((words, *cells, part["method"]))
    return line_charts({"variance, %": lines}, "components"), rows
