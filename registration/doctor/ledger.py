"""The ledger of a capture: of each channel the files, and how many of its pixels or points count in a registration.

What counts is what `registration.targets.pyramid` gives weight: whole pixels of the subject, of a class that the model
knows; normals that face the camera; colours where the normals do, if there are any. A channel of which (nearly) nothing
counts is refused; a large loss is a warning that names the reason.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.capture import class_names, triangulation
from registration.capture.samples import ViewSample
from registration.capture.text import listed
from registration.doctor import leftovers
from registration.doctor.findings import refuse
from registration.types import Capture, View

_INSIDE = 253  # of 255, the pyramid's 0.99
_NOTHING = 0.01  # of a channel: as good as nothing
_LARGE = 0.5  # share lost to one reason
_MIN_LENGTH = 0.5  # of a normal
_SOFT = "mask between 50 and 99 %"
_AWAY = "normal faces away"
_NO_NORMAL = "no normal"
_NO_DEPTH = "no depth"
_BACKGROUND = "labelled as background"
_UNUSED = f"confidence of {triangulation.MIN_CONFIDENCE} or less"
_CONTRADICT = "contradicts other views"
_OUTSIDE = "outside the image"
_CLASS = "class "

_Loss = tuple[str, Bool[np.ndarray, "h w"]]  # a reason, and the pixels that it concerns


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One kind of data of a capture."""

    name: str  # of its folder or file
    files: int  # on disk
    matched: int  # that belong to a view
    unit: str  # of the next three: pixels, points, vertices
    total: int  # of the subject, in sampled pixels; or points of all views
    counted: int
    losses: Mapping[str, int]  # reason -> how many it costs; a pixel has one reason

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of the table: channel, files, matched, what counts, what is lost."""
        if not self.matched:
            return (self.name, str(self.files or "-"), "-", "-", "")
        lost = [f"{_percent(count, self.total)} {reason}" for reason, count in self.losses.items() if count]
        share = f"{_percent(self.counted, self.total)} of {self.total} {self.unit}" if self.total else "-"
        return (self.name, str(self.files), str(self.matched), share, ", ".join(lost))


@dataclass(frozen=True, kw_only=True)
class Ledger:
    """What of a valid capture counts, and what may be wrong with it."""

    channels: tuple[Channel, ...]
    warnings: tuple[str, ...]
    unread: tuple[str, ...]  # files and folders that nothing reads, a line each
    coverage: Mapping[str, float | None]  # view's name -> fraction of the image that its mask covers; None: no mask
    head_rows: Mapping[str, int]  # view's name -> height of its head, px of the stored image


def take_stock(
    capture: Capture, samples: Sequence[ViewSample], files: Mapping[str, leftovers.FolderFiles]
) -> list[Channel]:
    """Count what each channel contributes.

    Args:
        capture: with landmarks.
        samples: of its views.
        files: of its folders.
    """
    mapped = {view.name: "depth" for view in capture.views if view.normals is None and view.depth is not None}
    depth = ("depth",) if any(view.depth is not None for view in capture.views) else ()
    totals = dict.fromkeys(("images", "masks", "normals", *depth, "segmentation"), 0)
    lost: dict[str, Counter[str]] = {name: Counter() for name in totals}

    def add(name: str, subject: Bool[np.ndarray, "h w"], losses: Sequence[_Loss]) -> None:
        totals[name] += int(subject.sum())
        lost[name] += _count(subject, losses)

    for sample in samples:
        inside, excluded = _inside(sample), _excluded(sample, capture.classes)
        normals = [] if sample.normals is None else _normal_losses(sample)
        if capture.photographs:  # else the images count for nothing, as capture.toml says
            add("images", sample.subject, [*inside, *excluded, *normals])
        if sample.mask is not None:
            add("masks", sample.subject, inside)
        if sample.normals is not None:
            add(mapped.get(sample.name, "normals"), sample.subject, [*inside, *excluded, *normals])
        if sample.depth is not None and sample.name not in mapped:
            add("depth", sample.subject, [*inside, *excluded, (_NO_DEPTH, sample.depth <= 0)])
        if sample.labels is not None:
            add("segmentation", sample.subject, [*inside, *_label_losses(sample, capture.classes)])
    totals["landmarks"], lost["landmarks"] = _landmark_counts(capture)
    return [_channel(name, files[name], totals[name], lost[name]) for name in totals]


def _channel(name: str, files: leftovers.FolderFiles, total: int, losses: Counter[str]) -> Channel:
    return Channel(
        name=name,
        files=files.files,
        matched=files.matched,
        unit="points" if name == "landmarks" else "sampled pixels",
        total=total,
        counted=total - losses.total(),
        losses=dict(losses.most_common()),
    )


def require_weight(capture: Capture, channels: Sequence[Channel]) -> list[str]:
    """Refuse channels of which nothing counts; return warnings of large losses.

    Raises:
        InputError: a channel was supplied, and ends with (nearly) no weight.
    """
    warnings: list[str] = []
    named: set[str] = set()
    order = ("masks", "segmentation", "landmarks", "normals", "depth", "images")  # a cause before what follows from it
    for channel in sorted(channels, key=lambda channel: order.index(channel.name)):
        if not channel.matched or (channel.name == "images" and not capture.photographs):
            continue
        if not channel.total and channel.name == "segmentation":
            raise refuse(
                "labels-empty",
                "The label maps show no subject",
                where=capture.root / channel.name,
                expected="classes of the head",
                got="background only",
                fix="check the label maps and the order of [segmentation] classes in capture.toml",
            )
        if not channel.total:
            warnings.append(f"{channel.name}: the {channel.matched} files hold nothing to compare")
            continue
        reason, lost = max(channel.losses.items(), key=lambda item: item[1], default=("", 0))
        if channel.counted <= _NOTHING * channel.total:
            raise refuse(
                _kind(channel, reason),
                f"Nothing of {channel.name}/ counts",
                where=capture.root / channel.name,
                expected=_expected(reason, capture.classes),
                got=f"{_percent(channel.counted, channel.total)} of the {channel.unit} count; lost: {_lost(channel)}",
                fix=_fix(reason, capture.classes),
            )
        if lost > _LARGE * channel.total and not _on_purpose(reason) and reason not in named:
            named.add(reason)
            warnings.append(
                f"{channel.name}: only {_percent(channel.counted, channel.total)} of the {channel.unit} count; "
                f"lost: {_lost(channel)}; {_fix(reason, capture.classes)}"
            )
    return warnings


def _kind(channel: Channel, reason: str) -> str:
    """The kind of the finding that nothing of a channel counts."""
    if reason.startswith(_CLASS):
        return "labels-vocabulary"
    return {_SOFT: "mask-values", _AWAY: "normals-axes", _OUTSIDE: "landmarks-outside"}.get(reason, channel.name)


def _inside(sample: ViewSample) -> list[_Loss]:
    return [] if sample.mask is None else [(_SOFT, sample.mask < _INSIDE)]


def _excluded(sample: ViewSample, classes: tuple[str, ...]) -> list[_Loss]:
    if sample.labels is None:
        return []
    unknown = [(index, name) for index, name in enumerate(classes) if name not in class_names.KNOWN]
    return [(f"{_CLASS}{name}", sample.labels == index) for index, name in unknown]


def _label_losses(sample: ViewSample, classes: tuple[str, ...]) -> list[_Loss]:
    losses = _excluded(sample, classes)
    if class_names.BACKGROUND in classes and sample.labels is not None:
        losses.append((_BACKGROUND, sample.labels == classes.index(class_names.BACKGROUND)))
    return losses


def _normal_losses(sample: ViewSample) -> list[_Loss]:
    assert sample.normals is not None
    length = np.linalg.norm(sample.normals, axis=-1)
    facing = -(sample.normals * sample.rays).sum(-1)
    return [(_NO_NORMAL, length < _MIN_LENGTH), (_AWAY, facing <= 0)]


def _count(subject: Bool[np.ndarray, "h w"], losses: Sequence[_Loss]) -> Counter[str]:
    """How many of the subject's pixels each reason costs that no earlier one did."""
    left, counts = subject.copy(), Counter[str]()
    for reason, lost in losses:
        counts[reason] += int((left & lost).sum())
        left &= ~lost
    return counts


def _landmark_counts(capture: Capture) -> tuple[int, Counter[str]]:
    total, losses = 0, Counter[str]()
    for scheme in sorted({name for view in capture.views for name in view.landmarks}):
        points = triangulation.triangulate(capture, scheme)[0]
        views = [view for view in capture.views if scheme in view.landmarks]
        used = np.stack([view.landmarks[scheme][:, 2] > triangulation.MIN_CONFIDENCE for view in views])
        for view in views:
            total += len(points)
            losses += _landmark_losses(view, scheme, points, used.sum(0) > 1)
    return total, losses


def _landmark_losses(
    view: View, scheme: str, points: Float[np.ndarray, "L 3"], compared: Bool[np.ndarray, "L"]
) -> Counter[str]:
    landmarks, camera = view.landmarks[scheme], view.camera
    used = landmarks[:, 2] > triangulation.MIN_CONFIDENCE
    size = np.array([camera.width_px, camera.height_px])
    outside = used & ((landmarks[:, :2] < 0) | (landmarks[:, :2] > size)).any(1)
    residuals = triangulation.residuals(view, scheme, points)
    contradicts = used & compared & ~outside & ~(residuals <= triangulation.inlier_limit_px(camera))
    return Counter({_UNUSED: int((~used).sum()), _OUTSIDE: int(outside.sum()), _CONTRADICT: int(contradicts.sum())})


def _on_purpose(reason: str) -> bool:
    """Whether a loss is how captures are: hidden landmarks, hair and clothes, subjects without normals in places."""
    return reason in (_UNUSED, _NO_NORMAL, _NO_DEPTH) or class_names.covers(reason.removeprefix(_CLASS))


def _lost(channel: Channel) -> str:
    return listed([f"{_percent(n, channel.total)} {reason}" for reason, n in channel.losses.items() if n], 4)


def _expected(reason: str, classes: tuple[str, ...]) -> str:
    if reason.startswith(_CLASS):
        return f"classes that the model knows: {', '.join(class_names.KNOWN)}"
    return {
        _SOFT: "masks of 255 inside the subject",
        _AWAY: "normals in the camera's frame, OpenCV's axes, that point towards the camera",
        _NO_NORMAL: "normals on the subject",
        _NO_DEPTH: "depths on the subject",
        _BACKGROUND: "labels of the subject where the masks show it",
        _UNUSED: f"confidences above {triangulation.MIN_CONFIDENCE} for points that are seen",
        _CONTRADICT: "landmarks on which at least two views agree",
        _OUTSIDE: "landmarks in pixels of the stored images",
    }[reason]


def _fix(reason: str, classes: tuple[str, ...]) -> str:
    if reason.startswith(_CLASS):
        hints = [(name, class_names.suggestion(name)) for name in classes if name not in class_names.KNOWN]
        renames = [f"{name} to {near}" for name, near in hints if near is not None]
        how = "in [segmentation] classes of capture.toml"
        return f"rename {listed(renames)} {how}" if renames else f"name the face's index skin {how}"
    return {
        _SOFT: "threshold the masks: 255 inside the subject, 0 outside",
        _AWAY: "turn the normals into the camera's frame: x right, y down, z away from the camera, so that z < 0",
        _NO_NORMAL: "check that normals/ belongs to these images; 0 means that a pixel has no normal",
        _NO_DEPTH: "check that depth/ belongs to these images; 0 means that a pixel has no depth",
        _BACKGROUND: "check that masks and label maps belong to the same images",
        _UNUSED: "write confidences from 0 to 1",
        _CONTRADICT: "check that landmarks are in pixels of the stored images, and the calibration",
        _OUTSIDE: "write landmarks in pixels of the stored images",
    }[reason]


def _percent(part: int, whole: int) -> str:
    share = 100 * part / max(whole, 1)
    return f"{share:.0f} %" if share >= 1 or part == 0 else f"{share:.1g} %"
