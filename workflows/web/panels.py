"""What pages say beside their scene, as HTML with inline drawings."""

from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from registration.report.pictures import SCALE
from registration.stabilize.components import Components, Head
from registration.stabilize.decisions import Change
from registration.stabilize.stabilized_folder import StoredComponents

_BINS, _REACH = 24, 3.0  # of a histogram: bars, and standard deviations either way
_MOST_LABELS = 24
_TOP = 10
_STYLE = """<style>
.rv { font: 13px/1.5 system-ui, sans-serif; color: #22262d; padding: 0 4px; }
.rv b { font-weight: 650; } .rv .soft { color: #666c76; } .rv table { border-collapse: collapse; width: 100%; }
.rv td { padding: 2px 6px 2px 0; font-variant-numeric: tabular-nums; border-bottom: 1px solid #ecece7; }
.rv td.num { text-align: right; } .rv h4 { margin: 8px 0 4px; font-size: 13px; font-weight: 650; }
.rv .flag { background: #b7791f; color: #fff; border-radius: 9px; padding: 1px 9px; font-weight: 600; }
.rv .ok { background: #1f7a74; color: #fff; border-radius: 9px; padding: 1px 9px; font-weight: 600; }
.rv i.bar { display: block; height: 10px; border-radius: 5px; }
</style>"""


def about(part: Components, k: int, action: str, head: Head) -> str:
    """Scores, and the rigid part in degrees and mm."""
    turn = np.degrees(np.linalg.norm(part.twists[k, :3]))
    moves = part.rigid_rms_mm(head)[k]
    badge = '<span class="flag">flagged</span>' if part.flagged[k] else '<span class="ok">not flagged</span>'
    rows = (
        ("energy of the region", f"{100 * part.energy[k]:.1f} %"),
        ("S · rigid, all in all", f"{part.score[k]:.2f}"),
        ("S1 · share of energy that is rigid", f"{part.rigid_share[k]:.2f}"),
        ("S2 · size of the rigid part", f"{part.rigid_size[k]:.2f}"),
        ("S3 · free of the label", f"{part.free_of_label[k]:.2f}"),
        ("S5 · shared by nose and neck", f"{part.shared[k]:.2f}"),
        ("rigid motion, one σ", f"{turn:.2f}° &nbsp; {moves:.2f} mm"),
    )
    cells = "".join(f'<tr><td>{name}</td><td class="num"><b>{value}</b></td></tr>' for name, value in rows)
    return f'{_STYLE}<div class="rv">{badge} &nbsp; now: <b>{action}</b><table>{cells}</table></div>'


def colour_bar(limit_mm: float, title: str) -> str:
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    return (
        f'{_STYLE}<div class="rv"><h4>{escape(title)}</h4>'
        f'<i class="bar" style="background:linear-gradient(90deg,{stops})"></i><span class="soft">0 mm</span>'
        f'<span class="soft" style="float:right">{limit_mm:g} mm</span></div>'
    )


def error(change: Change, undecided: int) -> str:
    """How the rebuilt set differs from what it was built from, right now."""
    rows = (
        ("rebuilt set differs by, rms", f"{change.rms_mm:.3f} mm"),
        ("the sample that changes most", f"{change.most_mm:.2f} mm"),
        ("heads turned by, rms", f"{change.turn_deg:.3f}°"),
        ("decisions not saved", f"{undecided}"),
    )
    cells = "".join(f'<tr><td>{name}</td><td class="num"><b>{value}</b></td></tr>' for name, value in rows)
    return f'{_STYLE}<div class="rv"><table>{cells}</table></div>'


def histogram(coefficients: Float[np.ndarray, "S"], labels: Sequence[str]) -> str:
    """A row of bars for each label: motion of the head looks alike in all, an expression stands apart."""
    edges = np.linspace(-_REACH, _REACH, _BINS + 1)
    names, of = np.unique(np.asarray(labels), return_inverse=True)
    order = np.argsort([coefficients[of == k].mean() for k in range(len(names))])[::-1]
    lines, step, wide, left = [], 14, 8, 104
    for row, k in enumerate(order[:_MOST_LABELS]):
        counts, _ = np.histogram(np.clip(coefficients[of == k], -_REACH, _REACH), edges)
        bars = "".join(
            f'<rect x="{left + wide * b}" y="{row * step + 13 - 11 * n / counts.max():.1f}" width="{wide - 1}" '
            f'height="{11 * n / counts.max():.1f}" fill="#1f7a74"/>'
            for b, n in enumerate(counts)
            if n
        )
        lines.append(
            f'<text x="{left - 6}" y="{row * step + 11}" text-anchor="end" font-size="10" fill="#22262d">'
            f"{escape(str(names[k]))[:18]}</text>{bars}"
        )
    rows = len(lines)
    middle, height, width = left + wide * _BINS / 2, rows * step + 16, left + wide * _BINS
    axis = "".join(
        f'<text x="{middle + s * wide * _BINS / 6}" y="{height - 3}" text-anchor="middle" font-size="10" '
        f'fill="#666c76">{s:+d}σ</text>'.replace("+0σ", "0")
        for s in (-2, 0, 2)
    )
    line = f'<line x1="{middle}" x2="{middle}" y1="0" y2="{rows * step}" stroke="#d9d9d4"/>'
    more = len(names) - rows
    rest = f'<span class="soft">and {more} more labels</span>' if more > 0 else ""
    return (
        f'{_STYLE}<div class="rv"><h4>Coefficients by expression</h4><svg viewBox="0 0 {width} {height}" width="100%">'
        f"{line}{''.join(lines)}{axis}</svg>{rest}</div>"
    )


def strongest(part: Components, k: int, stored: StoredComponents) -> str:
    """The ten samples that a component moves most."""
    coefficients = part.coefficients[:, k]
    rows = "".join(
        f"<tr><td>{escape(stored.subjects[s])}</td><td>{escape(stored.names[s])}</td>"
        f'<td class="num"><b>{coefficients[s]:+.1f} σ</b></td></tr>'
        for s in np.argsort(-np.abs(coefficients))[:_TOP]
    )
    return f'{_STYLE}<div class="rv"><h4>The ten samples it moves most</h4><table>{rows}</table></div>'
