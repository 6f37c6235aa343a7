"""The HTML page of a subject: a row for each capture; self-contained but for the links to the reports beside it."""

from collections.abc import Mapping
from html import escape
from urllib.parse import quote

import cv2
import numpy as np
import torch
from jaxtyping import Float

from registration.frames import axis_angle_to_matrix, linear_to_srgb
from registration.geometry.rasterizer import rasterize
from registration.report.pictures import PAPER, data_uri
from registration.report.style import document
from registration.types import Camera, Registration
from workflows.records.subject import Row, Subject

_WIDTH_PX, _HEIGHT_PX = 144, 192  # of a thumbnail
_OVERSAMPLING = 2
_CSS = """
.error { background: var(--bad); } .waiting, .skipped { background: var(--soft); }
td .badge { margin-left: 0; vertical-align: 0; } td { vertical-align: middle; }
.thumb { width: 110px; display: block; border-radius: 7px; } main { padding-top: 28px; }
.reason { color: var(--soft); font-size: 13.5px; max-width: 52ch; overflow-wrap: anywhere; }
"""


def thumbnail(registration: Registration) -> str | None:
    """The registered head in its texture, from the front, as a data URI; None if its vertices are not finite."""
    if not np.isfinite(registration.vertices).all():
        return None
    turn = axis_angle_to_matrix(torch.from_numpy(registration.rotations[0].astype(np.float64))).numpy()
    head = registration.vertices @ turn  # to the model's frame: +Y up, +Z out of the face
    camera = _front(head, _OVERSAMPLING * _WIDTH_PX, _OVERSAMPLING * _HEIGHT_PX)
    face, barycentric = rasterize(head, registration.triangles, camera)
    shown = face >= 0
    uv = np.einsum("pk,pkc->pc", barycentric[shown], registration.corner_uvs[face[shown]])
    size = len(registration.texture)
    column, line = (np.clip((uv * (1, -1) + (0, 1)) * size, 0, size - 1)).astype(np.int64).T
    picture = np.empty((*face.shape, 3), np.float32)
    picture[:] = PAPER
    picture[shown] = 255 * linear_to_srgb(registration.texture[line, column])
    small = cv2.resize(picture, (_WIDTH_PX, _HEIGHT_PX), interpolation=cv2.INTER_AREA)
    return data_uri(np.clip(small + 0.5, 0, 255).astype(np.uint8))


def _front(head: Float[np.ndarray, "V 3"], width_px: int, height_px: int) -> Camera:
    """A camera two metres before a head (model frame) that fills its picture."""
    low, high = head.min(0), head.max(0)
    distance = 2.0
    focal = 0.96 * distance * min(np.array([width_px, height_px]) / (high - low)[:2])
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ ((low + high) / 2) + (0, 0, distance)
    intrinsics = np.array([[focal, 0, width_px / 2], [0, focal, height_px / 2], [0, 0, 1]])
    return Camera(width_px=width_px, height_px=height_px, intrinsics=intrinsics, T_cam_world=pose)


def write_subject_page(subject: Subject, thumbnails: Mapping[str, str]) -> str:
    """The whole page; `thumbnails` are data URIs by the name of the row."""
    usable = sum(row.usable for row in subject.rows)
    waiting = sum(row.status == "waiting" for row in subject.rows)
    lead = f"{usable} of {len(subject.rows)} captures have a usable registration"
    lead += f", {waiting} {'is' if waiting == 1 else 'are'} waiting." if waiting else "."
    rows = "".join(_row(row, thumbnails.get(row.name)) for row in subject.rows)
    name = escape(subject.subject)
    body = (
        f'<header><div class="top"><div class="eyebrow">Head registrations of a subject</div><h1>{name}</h1>'
        f'<p class="lead">{lead}</p></div></header><main><div class="panel"><table><tr><th></th><th>capture</th>'
        '<th></th><th class="num">scan to mesh, mean</th><th class="num">median</th><th class="num">drift, mean</th>'
        f'<th class="num">time</th><th class="note">why</th></tr>{rows}</table></div>'
        f"<footer>Figures are of the face, in millimetres. Recipe {escape(subject.recipe)}; expressions start from "
        f'{escape(subject.neutral)}; model <span class="mono">{escape(subject.model[:16])}</span>.</footer></main>'
    )
    return document(f"{name} – registrations", body, css=_CSS, zooms=False)


def _row(row: Row, picture: str | None) -> str:
    name = escape(row.name)
    shown = f'<img class="thumb" alt="{name} from the front" src="{picture}">' if picture else ""
    if row.folder is not None:
        link = f'href="{quote(row.folder)}/report.html"'
        name, shown = f"<a {link}>{name}</a>", f"<a {link}>{shown}</a>"
    expression = f'<br><span class="reason">{escape(row.expression)}</span>' if row.expression != row.name else ""
    figures = (("scan_to_mesh", "mean_mm"), ("scan_to_mesh", "median_mm"), ("drift", "mean_mm"))
    cells = "".join(f'<td class="num">{_mm(row, *figure)}</td>' for figure in figures)
    return (
        f"<tr><td>{shown}</td><td>{name}{expression}</td>"
        f'<td><span class="badge {row.status}">{row.status}</span></td>{cells}'
        f'<td class="num">{"" if row.seconds is None else f"{row.seconds:.0f} s"}</td>'
        f'<td class="note reason">{escape(row.reason)}</td></tr>'
    )


def _mm(row: Row, figure: str, statistic: str) -> str:
    value = row.figures.get(figure, {}).get("face", {}).get(statistic)
    return "–" if value is None else f"{value:.3f}"
