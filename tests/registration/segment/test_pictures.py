"""The sheet that shows labels over photographs."""

import numpy as np

from registration.segment.fitted import INDEX
from registration.segment.labels import Labelled
from registration.segment.pictures import COLOURS, overlay, sheet
from registration.segment.views import SegmentView
from registration.types import Camera


def pair() -> tuple[SegmentView, Labelled]:
    camera = Camera(width_px=80, height_px=100, intrinsics=np.eye(3), T_cam_world=np.eye(4))
    labels = np.full((100, 80), INDEX["background"], np.uint8)
    labels[20:80, 10:70] = INDEX["skin"]
    labels[30:50, 20:40], labels[20:30, 10:70] = INDEX["left_eye"], INDEX["hair"]
    mask = (labels != INDEX["background"]).astype(np.float32)
    image = np.full((100, 80, 3), 120, np.uint8)
    return SegmentView(name="a", image=image, camera=camera), Labelled(name="a", mask=mask, labels=labels)


def test_classes_have_their_colours_and_what_is_left_out_is_hatched():
    view, labelled = pair()
    picture = overlay(view.image, labelled).astype(int)
    eye = picture[35:45, 25:35].reshape(-1, 3)
    assert (eye == eye[0]).all() and eye[0].argmax() == np.argmax(COLOURS["left_eye"])
    hair = picture[22:28, 12:68]
    assert len(np.unique(hair.reshape(-1, 3), axis=0)) > 1
    assert picture[5, 5].max() < 60 and (picture[60, 30] == 120).all()


def test_a_sheet_holds_all_views_and_a_legend():
    view, labelled = pair()
    picture = sheet([view] * 5, [labelled] * 5, columns=3, tile_px=200)
    assert picture.shape[0] > 2 * 200 + 20
    assert picture.shape[1] == 3 * (160 + 4)
