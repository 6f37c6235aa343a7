"""The names of label classes: those that the model knows, and what other vocabularies call them."""

import difflib
import re

from registration.model.regions import CLASSES

BACKGROUND = "background"
NECK = "neck_other"
KNOWN = (BACKGROUND, *CLASSES, NECK)

# What covers a head or is not known: excluded from every comparison on purpose.
_COVERS = re.compile(
    r"hair|beard|cloth|shirt|hat$|helmet|cap$|glass|eye_?g$|ear_?r(ing)?s?$|neck_?l(ace)?$|mask|band|hand|ignore|unlabel|void"
)
_OTHER_NAMES = {
    "bg": BACKGROUND,
    "back": BACKGROUND,
    "face": "skin",
    "facial_skin": "skin",
    "head": "skin",
    "nose": "skin",
    "brow": "skin",
    "l_brow": "skin",
    "r_brow": "skin",
    "left_brow": "skin",
    "right_brow": "skin",
    "left_eyebrow": "skin",
    "right_eyebrow": "skin",
    "l_eye": "left_eye",
    "eye_l": "left_eye",
    "eye_left": "left_eye",
    "r_eye": "right_eye",
    "eye_r": "right_eye",
    "eye_right": "right_eye",
    "u_lip": "upper_lip",
    "lip_upper": "upper_lip",
    "l_lip": "lower_lip",
    "lip_lower": "lower_lip",
    "ear": "ears",
    "l_ear": "ears",
    "r_ear": "ears",
    "left_ear": "ears",
    "right_ear": "ears",
    "mouth": "mouth_interior",
    "inner_mouth": "mouth_interior",
    "teeth": "mouth_interior",
    "tongue": "mouth_interior",
    "neck": NECK,
    "body": NECK,
    "torso": NECK,
}


def canonical(name: str) -> str:
    """Return a known class for a name that differs from it in case, spaces and hyphens only; else the name itself."""
    plain = _plain(name)
    return plain if plain in KNOWN else name


def suggestion(name: str) -> str | None:
    """Return the known class that an unknown name probably means; None if there is none, as for clothes."""
    plain = _plain(name)
    if plain in _OTHER_NAMES:
        return _OTHER_NAMES[plain]
    if covers(name):
        return None
    return next(iter(difflib.get_close_matches(plain, KNOWN, 1, 0.75)), None)


def covers(name: str) -> bool:
    """Whether a class is something that covers the head, such as hair or clothes: left out on purpose."""
    return _COVERS.search(_plain(name)) is not None


def _plain(name: str) -> str:
    return re.sub(r"[\s\-_.]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip())).casefold()
