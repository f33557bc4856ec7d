"""Poses in which avatars of others break, as keys of made motions (`motions.play_keys`); degrees."""

from dsar.evaluation.stress.motions import Key

_BOTH = ("left", "right")


def _legs(
    bend: float, knee: float, open_: float = 0.0, turn: float = 0.0
) -> dict[str, tuple[float, float, float]]:
    """Return both legs alike: thighs forward by `bend`, shins back by `knee`, opened and turned outwards."""
    sides = {"left": 1.0, "right": -1.0}
    return {f"{side}_hip": (-bend, sign * turn, sign * open_) for side, sign in sides.items()} | {
        f"{side}_knee": (knee, 0.0, 0.0) for side in _BOTH
    }


_ARMS_DOWN = {"left_shoulder": (0.0, 0.0, -70.0), "right_shoulder": (0.0, 0.0, 70.0)}
_ARMS_UP = {"left_shoulder": (0.0, 0.0, 75.0), "right_shoulder": (0.0, 0.0, -75.0)}
_ARMS_CROSSED = {
    "left_shoulder": (0.0, -70.0, -45.0),
    "right_shoulder": (0.0, 70.0, 45.0),
    "left_elbow": (0.0, -110.0, 0.0),
    "right_elbow": (0.0, 110.0, 0.0),
}
_HANDS_ON_SKIRT = {
    "left_shoulder": (0.0, -20.0, -75.0),
    "right_shoulder": (0.0, 20.0, 75.0),
    "left_elbow": (0.0, -30.0, 0.0),
    "right_elbow": (0.0, 30.0, 0.0),
}
_BOW = {"spine1": (35.0, 0.0, 0.0), "spine2": (30.0, 0.0, 0.0), "spine3": (20.0, 0.0, 0.0)}
_STANDING = Key(1.0, _ARMS_DOWN, hold=1.0)

CONTACT = (
    Key(0.8, _ARMS_CROSSED, hold=0.5),
    Key(0.8, _HANDS_ON_SKIRT, hold=0.5),
    Key(1.0, _legs(110.0, 130.0) | _ARMS_CROSSED, hold=1.0),
    Key(1.0, _legs(85.0, 125.0, 40.0, 35.0) | _HANDS_ON_SKIRT, hold=1.0),
    Key(1.0, _BOW | _ARMS_DOWN | _legs(40.0, 0.0), hold=0.5),
    _STANDING,
)
"""Arms crossed, hands on the skirt, a squat, a lotus, a bow."""

SHEAR = (
    Key(0.7, _legs(0.0, 0.0, 60.0) | _ARMS_DOWN, hold=0.7),
    Key(0.5, _ARMS_DOWN),
    Key(0.7, _ARMS_DOWN | {"left_hip": (-60.0, 0.0, 0.0), "right_hip": (60.0, 0.0, 0.0)}, hold=0.7),
    Key(0.8, _ARMS_DOWN | {"left_hip": (60.0, 0.0, 0.0), "right_hip": (-60.0, 0.0, 0.0)}, hold=0.7),
    Key(0.8, _ARMS_DOWN | {"left_hip": (-20.0, 0.0, 60.0), "right_hip": (20.0, 0.0, 0.0)}, hold=0.5),
    _STANDING,
)
"""Legs spread to the sides by 60 degrees each, then fore and aft, then one."""

FLOOR = (
    Key(0.8, _legs(10.0, 125.0) | _ARMS_DOWN, hold=1.0),
    Key(1.0, _legs(85.0, 10.0, 10.0) | _ARMS_DOWN, hold=1.0),
    Key(1.0, _ARMS_DOWN, hold=0.5),
    Key(0.5, _ARMS_DOWN | _legs(20.0, 30.0), turn=(-90.0, 0.0, 0.0), hold=1.5),
    Key(0.8, _ARMS_DOWN, turn=(0.0, 0.0, 90.0), hold=0.7),
    Key(0.8, _ARMS_DOWN, turn=(0.0, 0.0, 90.0), hold=1.0),
    Key(1.0, _ARMS_DOWN | _legs(60.0, 90.0), turn=(90.0, 0.0, 0.0), hold=0.5),
    Key(0.8, _ARMS_DOWN, turn=(0.0, 180.0, 0.0), hold=1.0),
)
"""Kneeling, seated on the ground, standing; a fall on the back in half a second, a roll to the side and on
the belly, and up again."""

EXTREME = (
    Key(0.3, _ARMS_DOWN | {"left_hip": (-115.0, 0.0, 0.0)}, hold=0.2),
    Key(0.3, _ARMS_DOWN | {"right_hip": (0.0, 0.0, -90.0), "spine1": (0.0, 0.0, -25.0)}, hold=0.2),
    Key(0.4, _legs(120.0, 145.0) | _ARMS_UP, hold=0.2),
    Key(0.4, _ARMS_UP | _legs(90.0, 110.0), turn=(-120.0, 0.0, 0.0), lift=0.25),
    Key(0.4, _ARMS_UP | _legs(110.0, 120.0), turn=(-120.0, 0.0, 0.0), lift=0.2),
    Key(0.4, _ARMS_UP | _legs(20.0, 30.0), turn=(-120.0, 0.0, 0.0)),
    Key(0.4, _legs(0.0, 0.0, 50.0) | _ARMS_UP, turn=(0.0, 0.0, 120.0)),
    Key(0.3, _legs(0.0, 0.0, 50.0) | _ARMS_UP, turn=(0.0, 0.0, 120.0)),
    Key(0.4, _legs(0.0, 0.0, 30.0) | _ARMS_UP, turn=(0.0, 0.0, 120.0), hold=0.2),
    Key(1.6, _ARMS_CROSSED, turn=(0.0, 1080.0, 0.0)),
    Key(0.5, _ARMS_DOWN, hold=1.0),
)
"""Kicks to the limits of a hip, a squat, a backflip, a cartwheel, three turns, up to 2.8 a second."""
