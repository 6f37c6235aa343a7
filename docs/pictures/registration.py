"""Renders docs/registration.jpg from the output of `make demo`.

python -m docs.pictures.registration CAPTURE REGISTRATION
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from registration.capture import native
from registration.capture.scan import read_scan
from registration.evaluate.distances import TriangleSurface, distances_mm
from registration.frames import linear_to_srgb
from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import vertex_normals
from registration.report.pictures import BACKGROUND, scale_colours
from registration.storage.registration_folder import load_registration
from registration.types import Registration, View

HEIGHT_PX = 430  # of a panel; each is rendered twice as large
OUT = Path(__file__).parents[1] / "registration.jpg"
LIMIT_MM = 0.1
CAPTIONS = ("capture (1 of {} views)", "registration", "mesh", "normals", "distance to the scan, 0 to 0.1 mm")
LIGHT = np.array([-0.45, -0.65, -0.61])  # from the camera's upper left
Picture = Float[np.ndarray, "H W 3"]  # sRGB in [0, 255]


def panels(view: View, registration: Registration, scan: TriangleSurface) -> list[Picture]:
    """Return the captured image and four renderings of the registration from the same camera."""
    image = cv2.imread(str(view.image))[..., ::-1].astype(float)
    camera = view.camera.scaled(2 * view.camera.width_px, 2 * view.camera.height_px)
    vertices, triangles = registration.vertices.astype(np.float64), registration.triangles.astype(np.int64)
    face, weight = rasterize(vertices, triangles, camera)
    shown = face >= 0
    face, weight = face[shown], weight[shown]
    corners = triangles[face]
    normal = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()
    normal = np.einsum("pk,pkc->pc", weight, normal[corners]) @ camera.T_cam_world[:3, :3].T
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shading = 0.55 + 0.5 * np.clip(normal @ LIGHT, 0, 1)
    uv = np.einsum("pk,pkc->pc", weight, registration.corner_uvs[face])
    # Triangles come in pairs that make a quad: the side from their last corner to their first is its diagonal.
    line = (weight[:, [0, 2]] < 0.06).any(1)
    mesh = np.array([150, 214, 200]) * shading[:, None] * np.where(line, 0.6, 1.0)[:, None]
    used = np.unique(corners)
    distance = np.zeros(len(vertices))
    distance[used] = distances_mm(vertices[used], scan)
    heat = scale_colours((weight * distance[corners]).sum(1) / LIMIT_MM) * shading[:, None]
    colour = 255 * linear_to_srgb(_texels(registration.texture, uv))
    renderings = [colour, mesh, 127.5 * (normal * (1, -1, -1) + 1), heat]
    results = [image]
    for values in renderings:
        picture = np.empty((*shown.shape, 3))
        picture[:] = BACKGROUND
        picture[shown] = values
        results.append(cv2.resize(picture, image.shape[1::-1], interpolation=cv2.INTER_AREA))
    return results


def _texels(texture: Float[np.ndarray, "R R 3"], uv: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    size = len(texture)
    column, row = (np.clip((c * size).astype(int), 0, size - 1) for c in (uv[:, 0], 1 - uv[:, 1]))
    return texture[row, column]


def labelled(panel: Picture, text: str) -> np.ndarray:
    """Return a panel at its final size, 8 bits, with its caption below."""
    scale = HEIGHT_PX / panel.shape[0]
    small = cv2.resize(panel, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    label = np.full((26, small.shape[1], 3), 255, np.uint8)
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.4
    left = (small.shape[1] - cv2.getTextSize(text, font, size, 1)[0][0]) // 2
    label = cv2.putText(label, text, (left, 17), font, size, (60, 60, 60), 1, cv2.LINE_AA)
    return np.concatenate([np.clip(small + 0.5, 0, 255).astype(np.uint8), label])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("registration", type=Path)
    parser.add_argument("--view", default="cam11")
    arguments = parser.parse_args()
    capture, registration = native.read_capture(arguments.capture), load_registration(arguments.registration)
    view = next(v for v in capture.views if v.name == arguments.view)
    raw = read_scan(capture.scan)
    drawn = panels(view, registration, TriangleSurface(vertices=raw.vertices, triangles=raw.triangles))
    captions = [caption.format(len(capture.views)) for caption in CAPTIONS]
    picture = np.concatenate([labelled(panel, text) for panel, text in zip(drawn, captions, strict=True)], 1)
    cv2.imwrite(str(OUT), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(OUT)


if __name__ == "__main__":
    main()
