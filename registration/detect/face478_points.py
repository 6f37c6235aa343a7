"""Named points and outlines of the scheme "face478": MediaPipe's face mesh of 468 points, and ten of the irises.

Left and right are the subject's. Lines of the lips run from the subject's right to the left corner, those of lids and
brows from the outer to the inner end; polygons are closed and begin at the same point. Source: the connections of
MediaPipe's face mesh (Apache-2.0), ordered along each outline.
"""

COUNT = 478

LIPS_OUTER_UPPER = (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291)  # the border of the red
LIPS_OUTER_LOWER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291)
LIPS_INNER_UPPER = (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308)  # the border of the open mouth
LIPS_INNER_LOWER = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308)

RIGHT_LID_UPPER = (33, 246, 161, 160, 159, 158, 157, 173, 133)  # the lids' rims, both corners included
RIGHT_LID_LOWER = (33, 7, 163, 144, 145, 153, 154, 155, 133)
LEFT_LID_UPPER = (263, 466, 388, 387, 386, 385, 384, 398, 362)
LEFT_LID_LOWER = (263, 249, 390, 373, 374, 380, 381, 382, 362)

RIGHT_PUPIL, LEFT_PUPIL = 468, 473  # the centres of the irises
RIGHT_IRIS = (469, 470, 471, 472)  # the borders of the irises, a quarter turn from one to the next
LEFT_IRIS = (474, 475, 476, 477)

RIGHT_BROW_UPPER = (70, 63, 105, 66, 107)
RIGHT_BROW_LOWER = (46, 53, 52, 65, 55)
LEFT_BROW_UPPER = (300, 293, 334, 296, 336)
LEFT_BROW_LOWER = (276, 283, 282, 295, 285)

NOSE_BRIDGE = (168, 6, 197, 195, 5, 4, 1)  # from between the eyes to the tip
NOSE_BASE = (98, 97, 2, 326, 327)  # from the subject's right wing to the left one

# From the middle of the forehead over the subject's left to the chin and back. These points slide along the silhouette.
FACE_OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152),
    *(148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)


def polygon(upper: tuple[int, ...], lower: tuple[int, ...]) -> tuple[int, ...]:
    """Return the closed outline of two lines of one direction: along the upper one, back along the lower one."""
    return upper + tuple(index for index in reversed(lower) if index not in upper)


LIPS_OUTER = polygon(LIPS_OUTER_UPPER, LIPS_OUTER_LOWER)
LIPS_INNER = polygon(LIPS_INNER_UPPER, LIPS_INNER_LOWER)
RIGHT_LIDS = polygon(RIGHT_LID_UPPER, RIGHT_LID_LOWER)
LEFT_LIDS = polygon(LEFT_LID_UPPER, LEFT_LID_LOWER)
RIGHT_BROW = polygon(RIGHT_BROW_UPPER, RIGHT_BROW_LOWER)
LEFT_BROW = polygon(LEFT_BROW_UPPER, LEFT_BROW_LOWER)

REGIONS = {  # of measurements
    "lids": tuple(sorted({*RIGHT_LIDS, *LEFT_LIDS})),
    "irises": (RIGHT_PUPIL, *RIGHT_IRIS, LEFT_PUPIL, *LEFT_IRIS),
    "lips": tuple(sorted({*LIPS_OUTER, *LIPS_INNER})),
    "nose": (*NOSE_BRIDGE, *NOSE_BASE),
    "brows": (*RIGHT_BROW, *LEFT_BROW),
    "oval": FACE_OVAL,
}
