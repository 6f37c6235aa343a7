"""The correspondence between the label classes of a capture and those of the model."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.capture.class_names import BACKGROUND, NECK
from registration.model.regions import CLASSES

SKIN = CLASSES[0]


@dataclass(frozen=True, kw_only=True)
class ClassMap:
    """K shared classes. What the capture does not distinguish is skin; what is unknown to the model is excluded."""

    names: tuple[str, ...]
    from_capture: Float[np.ndarray, "C K"]
    from_model: Float[np.ndarray, "M K"]
    excluded: Float[np.ndarray, "C"]  # 1 for hair, clothes and other classes without a counterpart
    neck: Float[np.ndarray, "C"]  # 1 for the neck: skin, but its silhouette is not compared


def class_map(capture_classes: tuple[str, ...]) -> ClassMap:
    """Return the classes that a capture shares with every model.

    Args:
        capture_classes: names of the label indices; may be empty.
    """
    names = tuple(name for name in CLASSES if name == SKIN or name in capture_classes)
    shared = {name: name for name in names} | {NECK: SKIN}

    def one_hot(labels: tuple[str, ...], otherwise: str | None) -> Float[np.ndarray, "R K"]:
        return np.array(
            [[shared.get(label, otherwise) == name for name in names] for label in labels], np.float32
        ).reshape(len(labels), len(names))

    return ClassMap(
        names=names,
        from_capture=one_hot(capture_classes, None),
        from_model=one_hot(CLASSES, SKIN),
        excluded=np.array([c not in shared and c != BACKGROUND for c in capture_classes], np.float32),
        neck=np.array([c == NECK for c in capture_classes], np.float32),
    )
