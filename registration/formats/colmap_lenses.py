"""The lenses of a COLMAP model: intrinsics and distortion of each of its camera models."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from registration.capture.colmap import INTRINSICS, PosedImage, check_camera
from registration.errors import InputError
from registration.formats.source import Distortion

_Lens = tuple[float, float, float, float, str, tuple[float, ...]]  # fx, fy, cx, cy, model, coefficients

_FISHEYES: Mapping[str, Callable[..., _Lens]] = {
    "SIMPLE_FISHEYE": lambda f, cx, cy: (f, f, cx, cy, "opencv_fisheye", ()),
    "FISHEYE": lambda fx, fy, cx, cy: (fx, fy, cx, cy, "opencv_fisheye", ()),
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, *k: (f, f, cx, cy, "opencv_fisheye", k),
    "RADIAL_FISHEYE": lambda f, cx, cy, *k: (f, f, cx, cy, "opencv_fisheye", k),
    "OPENCV_FISHEYE": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "opencv_fisheye", k),
    "THIN_PRISM_FISHEYE": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "thin_prism_fisheye", k),
    "RAD_TAN_THIN_PRISM_FISHEYE": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "rad_tan_thin_prism_fisheye", k),
    "FOV": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "fov", k),
    "SIMPLE_DIVISION": lambda f, cx, cy, *k: (f, f, cx, cy, "division", k),
    "DIVISION": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "division", k),
    "EUCM": lambda fx, fy, cx, cy, *k: (fx, fy, cx, cy, "eucm", k),
}


def lens_of(image: PosedImage) -> tuple[Float[np.ndarray, "3 3"], Distortion]:
    """Return K (px, first pixel's centre at 0.5) and the distortion of an image's camera.

    Raises:
        InputError: its numbers are not usable, or its images are panoramas.
    """
    source = image.camera
    if source.model not in INTRINSICS and source.model not in _FISHEYES:
        raise InputError(
            "The camera model is not one of a lens",
            where=image.where,
            expected=", ".join((*INTRINSICS, *_FISHEYES)),
            got=source.model,
            fix="cut the panoramas into perspective images, as COLMAP's example panorama_sfm.py does, and import those",
        )
    check_camera(image)
    if source.model in INTRINSICS:
        fx, fy, cx, cy, *coefficients = INTRINSICS[source.model](*source.parameters)
        plain = not any(coefficients)
        distortion = Distortion(model="none") if plain else Distortion(model="opencv", coefficients=tuple(coefficients))
    else:
        fx, fy, cx, cy, model, lens = _FISHEYES[source.model](*source.parameters)
        distortion = Distortion(model=model, coefficients=lens)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion
