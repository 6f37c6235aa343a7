"""Pictures of a scan from virtual cameras: its colours, or its shape in grey, and its normals where they count."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.errors import InputError
from registration.geometry.surface_views import SurfaceView
from registration.scan_capture.hygiene import RawScan
from registration.storage.image_files import decode, image_size
from registration.types import Camera

_BACKGROUND = 0.03  # sRGB
_SHADE = (0.15, 0.7)  # of a face that the camera sees edge-on, and what is added from the front


class Colours:
    """The colours of a scan, ready to be looked up; sRGB in [0, 1]."""

    def __init__(self, scan: RawScan):
        """Decode the textures. Raises InputError for one that cannot be decoded."""
        self._scan = scan
        self._textures = [_decoded(texture) for texture in scan.textures]

    def of(self, view: SurfaceView, camera: Camera) -> Float[np.ndarray, "H W 3"]:
        """Return the picture of a view: shaded grey where the scan has no colour."""
        hit = view.face >= 0
        picture = np.full((*hit.shape, 3), _BACKGROUND)
        facing = np.abs(view.normals[hit] @ camera.T_cam_world[2, :3])
        picture[hit] = (_SHADE[0] + _SHADE[1] * facing)[:, None]
        face, share = view.face[hit], view.barycentric[hit]
        if self._scan.colours is not None:
            picture[hit] = np.einsum("pk,pkc->pc", share, self._scan.colours[self._scan.triangles[face]])
        if self._textures and self._scan.corner_uvs is not None and self._scan.face_textures is not None:
            values = picture[hit]
            uv = np.einsum("pk,pkc->pc", share, self._scan.corner_uvs[face])
            for number, texture in enumerate(self._textures):
                own = (self._scan.face_textures[face] == number) & np.isfinite(uv).all(1)
                values[own] = _looked_up(texture, uv[own])
            picture[hit] = values
        return picture


def _looked_up(texture: UInt8[np.ndarray, "R C 3"], uv: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    """The colours at some uvs, interpolated; textures repeat."""
    height, width = texture.shape[:2]
    wrapped = uv - np.floor(uv)
    x = (wrapped[:, 0] * width - 0.5).astype(np.float32)
    y = ((1 - wrapped[:, 1]) * height - 0.5).astype(np.float32)
    rows = 1 << 14  # cv2.remap takes images of fewer than 2^15 rows
    found = [
        cv2.remap(
            texture, x[k : k + rows, None], y[k : k + rows, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for k in range(0, len(x), rows)
    ]
    return np.concatenate(found)[:, 0] / 255.0 if found else np.zeros((0, 3))


def _decoded(texture: Path | UInt8[np.ndarray, "R C 3"]) -> UInt8[np.ndarray, "R C 3"]:
    if isinstance(texture, np.ndarray):
        return texture

    def refuse(*, expected: object, got: object) -> InputError:
        fix = "export the scan again, or remove the texture's line from its material file"
        return InputError("The scan's texture cannot be used", where=texture, expected=expected, got=got, fix=fix)

    image_size(texture, refuse)
    return decode(texture, cv2.IMREAD_COLOR, refuse)[..., ::-1].copy()


def camera_normals(view: SurfaceView, camera: Camera, counted: Bool[np.ndarray, "F"]) -> Float[np.ndarray, "H W 3"]:
    """Return a view's normals in the camera's frame, 0 where they cannot be trusted or their face does not count."""
    trusted = (view.weight > 0) & (view.face >= 0) & counted[np.maximum(view.face, 0)]
    return np.where(trusted[..., None], view.normals @ camera.T_cam_world[:3, :3].T, 0.0)
