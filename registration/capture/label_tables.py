"""Label vocabularies of face parsers and data sets: the names of their indices, their colours, and whose left is left.

The sides were looked up in images, not in names: where a table's left eye lies in its authors' annotated examples.
"""

from dataclasses import dataclass
from typing import Literal

from registration.capture.class_names import KNOWN, UNLABELLED, exchanged, meanings

Side = Literal["subject", "image"]
Colours = tuple[tuple[int, int, int], ...]  # red, green, blue of each index


@dataclass(frozen=True, kw_only=True)
class LabelTable:
    """The label maps of one program or data set."""

    name: str  # in capture.toml
    names: tuple[str, ...]  # of the indices, as the source spells them
    left: Side  # whose left its "left" is
    source: str  # where names, order and sides come from
    colours: Colours = ()  # of its maps in colour; (): it has none

    @property
    def classes(self) -> tuple[str, ...]:
        """The class of each index, left and right the subject's."""
        found = meanings(self.names)
        classes = [found[name] or name for name in self.names]
        return tuple(exchanged(name) if self.left == "image" else name for name in classes)


_CELEBAMASK = (
    "background skin nose eye_g l_eye r_eye l_brow r_brow l_ear r_ear mouth u_lip l_lip hair hat ear_r neck_l neck"
    " cloth"
)
_CELEBAMASK_FIRST = (
    "background skin neck hat eye_g hair ear_r neck_l cloth l_eye r_eye l_brow r_brow nose l_ear r_ear mouth u_lip"
    " l_lip"
)
_BISENET = (
    "background skin l_brow r_brow l_eye r_eye eye_g l_ear r_ear ear_r nose mouth u_lip l_lip neck neck_l cloth hair"
    " hat"
)
_FACER = "background neck face cloth rr lr rb lb re le nose imouth llip ulip hair eyeg hat earr neck_l"
_LAPA = "background skin left_eyebrow right_eyebrow left_eye right_eye nose upper_lip inner_mouth lower_lip hair"
_SAPIENS = (
    "Background Apparel Face_Neck Hair Left_Foot Left_Hand Left_Lower_Arm Left_Lower_Leg Left_Shoe Left_Sock "
    "Left_Upper_Arm Left_Upper_Leg Lower_Clothing Right_Foot Right_Hand Right_Lower_Arm Right_Lower_Leg Right_Shoe "
    "Right_Sock Right_Upper_Arm Right_Upper_Leg Torso Upper_Clothing Lower_Lip Upper_Lip Lower_Teeth Upper_Teeth Tongue"
)


def _colours(digits: str) -> Colours:
    """Colours from six hexadecimal digits each."""
    return tuple(tuple(bytes.fromhex(colour)) for colour in digits.split())  # type: ignore[misc]


_CELEBAMASK_COLOURS = _colours(
    "000000 cc0000 4c9900 cccc00 3333ff cc00cc 00ffff ffcccc 663300 ff0000 66cc00 ffff00 000099 0000cc ff3399 00cccc"
    " 003300 ff9933 00cc00"
)

TABLES = (
    LabelTable(
        name="gnm",
        names=KNOWN,
        left="subject",
        source="this project's own, in the order that its studio writes",
    ),
    LabelTable(
        name="celebamask_hq",
        names=tuple(_CELEBAMASK.split()),
        left="subject",
        source="CelebAMask-HQ, face_parsing/README.md, and jonathandinu/face-parsing; sides by the four annotated"
        " samples of MaskGAN_demo/samples",
        colours=_CELEBAMASK_COLOURS,
    ),
    LabelTable(
        name="celebamask_hq_first",
        names=tuple(_CELEBAMASK_FIRST.split()),
        left="subject",
        source="CelebAMask-HQ, list1 of face_parsing/Data_preprocessing/g_mask.py: its first order",
    ),
    LabelTable(
        name="bisenet",
        names=tuple(_BISENET.split()),
        left="subject",
        source="face-parsing.PyTorch, prepropess_data.py, and its ports (facexlib, uniface). It was trained on mirrored"
        " images whose sides were not exchanged (its pull request 26): check the eyes",
    ),
    LabelTable(
        name="lapa",
        names=tuple(_LAPA.split()),
        left="image",
        source="LaPa, labelmap.txt and colormap.txt; sides by the eight faces of sample.png; also facer farl/lapa/448,"
        " which calls the same indices rb, lb, re, le after the subject's sides",
        colours=_colours("000000 0099ff 66ff99 00cc99 ffff66 ffffcc ff9900 ff66ff 660033 ffccff ff0066"),
    ),
    LabelTable(
        name="facer_celebm",
        names=tuple(_FACER.split()),
        left="image",
        source="facer farl/celebm/448, face_parsing/farl.py; sides by the label map in samples/face_parsing.ipynb and"
        " by its training data: re is CelebAMask-HQ's l_eye",
    ),
    LabelTable(
        name="pixel3dmm",
        names=(*_FACER.split(), UNLABELLED, UNLABELLED),
        left="image",
        source="pixel3dmm, scripts/run_facer_segmentation.py: facer farl/celebm/448, and 20 where facer saw nothing",
    ),
    LabelTable(
        name="sapiens",
        names=tuple(_SAPIENS.split()),
        left="subject",
        source="Sapiens, docs/SEG_README.md: 28 classes of Goliath; eyes and ears are not distinguished",
        colours=_colours(
            "323232 ffda00 80c8ff ff006d bd00cc ff00da 00a0cc 00ff91 cc0083 b600ff ff6d00 00ffff 4800ff cc8300 ff0000"
            " 48ff00 bdcc00 b6ff00 6600cc 2048cc 0091ff 0ecc00 008048 ebcd77 73e370 9d718f 845d32 521572"
        ),
    ),
    LabelTable(
        name="mediapipe_multiclass",
        names=("background", "hair", "body-skin", "face-skin", "clothes", "others"),
        left="subject",
        source="MediaPipe, selfie multiclass segmenter; eyes, lips and ears are not distinguished",
    ),
)
_BY_NAME = {table.name: table for table in TABLES}


def find(name: str) -> LabelTable | None:
    """Return the table of a name; case, hyphens and spaces do not matter."""
    return _BY_NAME.get(name.strip().casefold().replace("-", "_").replace(" ", "_"))


def names() -> str:
    """The names of all tables, for messages."""
    return ", ".join(_BY_NAME)
