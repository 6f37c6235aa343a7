"""Every number of a comparison of models on the face, as rows of one table."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coregister.evaluate.confidence_intervals import Interval
from coregister.evaluate.face_tables import DENSITY_EDGES_MM, Agreement, Density, FaceCurve, FaceRow

COLUMNS = ("model", "stage", "kind", "name", "statistic", "value", "low", "high", "subjects", "samples")


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceComparison:
    """Results of all models on the same samples."""

    models: tuple[str, ...]
    samples: int
    subjects: int
    rows: tuple[FaceRow, ...]
    agreements: tuple[Agreement, ...]
    curves: tuple[FaceCurve, ...]
    densities: tuple[Density, ...]
    compactness_mm: Mapping[str, Mapping[str, Float[np.ndarray, "k"]]]  # model -> part -> by number of components
    specificity_mm: Mapping[str, Sequence[tuple[int, Interval]]]  # model -> number of components, mean distance
    vertex_mm: Mapping[str, Float[np.ndarray, "V"]]  # model -> mean distance at the reference's vertices
    unconverged: Mapping[str, int]  # model -> number of least-squares fits
    left_out: float  # mean share of the points near the face that were not measured
    largest: Mapping[str, float]  # model -> largest coefficient of all fits, standard deviations

    def row(self, model: str, stage: str, kind: str = "face", name: str = "face") -> FaceRow | None:
        """Return one row, None if there is none."""
        wanted = (model, stage, kind, name)
        return next((row for row in self.rows if (row.model, row.stage, row.kind, row.name) == wanted), None)

    def csv(self) -> str:
        """Return all numbers, one a line; millimetres but for shares and ratios."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for line in self._lines():
            writer.writerow(f"{v:.6g}" if isinstance(v, float) else "" if v is None else v for v in line)
        return stream.getvalue()

    def _lines(self) -> Iterator[tuple[object, ...]]:
        for row in self.rows:
            head, tail = (row.model, row.stage, row.kind, row.name), (row.subjects, row.samples)
            yield (*head, "mean", row.mean.mean, row.mean.low, row.mean.high, *tail)
            yield (*head, "median", row.median, None, None, *tail)
            yield (*head, "std", row.std, None, None, *tail)
        for item in self.agreements:
            pair = (item.model, item.stage, "optimizer")
            for name, mean, rms in (
                ("least squares", item.least_squares_mm, item.rms_least_squares_mm),
                ("adam", item.adam_mm, item.rms_adam_mm),
            ):
                yield (*pair, name, "mean", mean, None, None, None, item.samples)
                yield (*pair, name, "rms of the objective", rms, None, None, None, item.samples)
            ratio = item.ratio
            yield (*pair, "adam / least squares", "ratio", ratio.mean, ratio.low, ratio.high, None, item.samples)
            yield (*pair, "adam", "settled", item.settled, None, None, None, item.samples)
        for curve in self.curves:
            own = (curve.model, "stage1", f"generalization {curve.part}")
            for count, value in zip(curve.components, curve.intervals, strict=True):
                yield (*own, count, "mean", value.mean, value.low, value.high, curve.subjects, None)
        for density in self.densities:
            for low, share in zip(DENSITY_EDGES_MM[:-1], density.share, strict=True):
                place = (density.model, density.stage, "density", f"from {low:.2f} mm")
                yield (*place, "share", float(share), None, None, None, None)
        for model, parts in self.compactness_mm.items():
            for part, values in parts.items():
                for number, rms in enumerate(values, 1):
                    yield (model, None, f"compactness {part}", number, "rms", float(rms), None, None, None, None)
        for model, counts in self.specificity_mm.items():
            for count, value in counts:
                yield (model, None, "specificity", count, "mean", value.mean, value.low, value.high, None, None)
