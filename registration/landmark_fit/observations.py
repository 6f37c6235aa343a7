"""What a landmark fit is given: landmarks in the images of one subject, and what is known of the cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.pixels import undistort_landmarks
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.errors import InputError
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Capture

MIN_POINTS = 20  # landmarks seen in the images of one frame


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewCamera:
    """What is known of one view's camera: a pinhole with square pixels and, if estimated, one radial coefficient."""

    width_px: int
    height_px: int
    focal_px: float | None = None  # None: unknown
    principal_px: tuple[float, float] | None = None  # None: near the image's centre, of a lens that may distort
    T_cam_world: Float[np.ndarray, "4 4"] | None = None  # None: unknown; a single view's camera frame is the world
    group: int = 0  # views of one group share an unknown focal length

    @classmethod
    def of(cls, camera: Camera) -> "ViewCamera":
        """The calibrated camera, without its distortion and skew: landmarks have to be `square_pixels`."""
        K = camera.intrinsics
        return cls(
            width_px=camera.width_px,
            height_px=camera.height_px,
            focal_px=float(np.sqrt(K[0, 0] * K[1, 1])),
            principal_px=(float(K[0, 2]), float(K[1, 2])),
            T_cam_world=camera.T_cam_world,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Landmarks of one subject in F frames, each seen by the same N views at once: L landmarks of one scheme.

    Pixels have the centre of pixel (0, 0) at (0.5, 0.5).
    """

    scheme: LandmarkScheme  # of the model
    views: tuple[ViewCamera, ...]
    points_px: Float[np.ndarray, "F N L 2"]  # NaN: not seen
    sigma_px: Float[np.ndarray, "F N L"]  # standard deviation along each axis

    def __post_init__(self) -> None:
        for name in ("points_px", "sigma_px"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        shape = (len(self.points_px), len(self.views), len(self.scheme.indices))
        if self.points_px.shape != (*shape, 2) or self.sigma_px.shape != shape:
            raise InputError(
                "Landmarks have another shape than frames, views and scheme",
                where="observations",
                expected=f"points {(*shape, 2)} and standard deviations {shape}",
                got=f"{self.points_px.shape} and {self.sigma_px.shape}",
                fix="give points as frames x views x landmarks x 2, NaN where a landmark is not seen",
            )
        bad = self.seen & ~((self.sigma_px > 0) & np.isfinite(self.sigma_px))
        if bad.any():
            raise InputError(
                "The standard deviation of a landmark is no positive number",
                where="observations.sigma_px at frame, view, landmark " + str(tuple(np.argwhere(bad)[0].tolist())),
                expected="pixels above 0",
                got=self.sigma_px[bad][0],
                fix="state how exact the landmarks are, or NaN in points_px for those that do not count",
            )
        for i, view in enumerate(self.views):
            if view.focal_px is not None and not (np.isfinite(view.focal_px) and view.focal_px > 0):
                raise InputError(
                    "The focal length is no positive number",
                    where=f"view {i}",
                    expected="pixels above 0, or None if it is unknown",
                    got=view.focal_px,
                    fix="state the focal length in pixels of this image",
                )

    @property
    def seen(self) -> Bool[np.ndarray, "F N L"]:
        """Which landmarks are seen."""
        return np.isfinite(self.points_px).all(-1)

    def frames(self, indices: Sequence[int] | np.ndarray) -> "Observations":
        """The observations of some frames."""
        chosen = np.asarray(indices)
        return Observations(
            scheme=self.scheme, views=self.views, points_px=self.points_px[chosen], sigma_px=self.sigma_px[chosen]
        )

    @classmethod
    def of_image(
        cls,
        scheme: LandmarkScheme,
        points_px: Float[np.ndarray, "L 2"],
        size_px: tuple[int, int],
        *,
        sigma_px: float | Float[np.ndarray, "L"] = 1.0,
        focal_px: float | None = None,
    ) -> "Observations":
        """The landmarks of one image.

        Args:
            scheme: of the model.
            points_px: NaN where not seen.
            size_px: width and height of the image.
            sigma_px: standard deviation of the points along each axis.
            focal_px: of the camera, if known.
        """
        points = np.asarray(points_px, np.float64)[None, None]
        view = ViewCamera(width_px=size_px[0], height_px=size_px[1], focal_px=focal_px)
        sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), points.shape[:-1]).copy()
        return cls(scheme=scheme, views=(view,), points_px=points, sigma_px=sigma)


def of_capture(capture: Capture, scheme: LandmarkScheme, default_sigma_px: float = 1.0) -> Observations:
    """The landmarks of a capture with calibrated cameras: one frame.

    Args:
        capture: landmarks above `MIN_CONFIDENCE` count, by their spread where the views state it.
        scheme: of the model; views without it show nothing.
        default_sigma_px: standard deviation of landmarks without a spread.
    """
    count, views = len(scheme.indices), capture.views
    points, sigma = np.full((1, len(views), count, 2), np.nan), np.full((1, len(views), count), default_sigma_px)
    for i, view in enumerate(views):
        if scheme.name not in view.landmarks:
            continue
        pixels = undistort_landmarks(view, scheme.name)
        confident = (pixels[:, 2] > MIN_CONFIDENCE) & np.isfinite(pixels).all(1)
        points[0, i, confident] = square_pixels(pixels[confident, :2], view.camera)
        if scheme.name in view.landmark_spread_px:
            spread = view.landmark_spread_px[scheme.name]
            sigma[0, i] = np.where(np.isfinite(spread) & (spread > 0), spread, default_sigma_px)
    cameras = tuple(ViewCamera.of(view.camera) for view in views)
    return Observations(scheme=scheme, views=cameras, points_px=points, sigma_px=sigma)


def square_pixels(points_px: Float[np.ndarray, "P 2"], camera: Camera) -> Float[np.ndarray, "P 2"]:
    """Undistorted pixels of a calibrated camera as `ViewCamera.of` sees them: no skew, square pixels."""
    view = ViewCamera.of(camera)
    assert view.focal_px is not None and view.principal_px is not None
    homogeneous = np.concatenate([points_px, np.ones((len(points_px), 1))], 1)
    rays = np.linalg.solve(camera.intrinsics, homogeneous.T).T
    return view.focal_px * rays[:, :2] + view.principal_px
