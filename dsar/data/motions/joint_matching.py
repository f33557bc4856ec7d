"""Which joint of a foreign skeleton is which of ours: by the names in use, else by the figure's shape."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import torch
from jaxtyping import Float
from torch import Tensor

SIDES = ("left", "right")
# What the joint is called at which each limb's bones begin and end, in words of English and of anatomy.
# Where a skeleton uses two of them, the first is meant: with a LeftArm, the LeftShoulder is the collar.
_WORDS = {
    "hip": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "knee": ("knee", "lowleg", "lowerleg", "shin", "calf", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "shoulder": ("upperarm", "uparm", "shldr", "humerus", "arm", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "radius"),
    "wrist": ("wrist", "hand"),
}
_CHAINS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
_TOES, _NOT_TOES = ("toe", "ball"), ("heel", "twist", "ik")
_LIMB = 0.2
"""Share of the figure's longest limb that a chain of joints must have to be a limb."""
_ALIKE = 0.1
"""Relative difference of a left and a right limb's lengths."""


@dataclass(frozen=True)
class JointMatch:
    """Where a person's joints are in a skeleton."""

    limbs: dict[str, int]
    """Joints of the limbs by our names; collars and feet (toes) only where there are any."""
    trunk: tuple[int, ...]
    """From the joint that carries the legs to the one that carries the arms, both included."""
    neck: tuple[int, ...]
    """Joints between chest and head."""
    head: int | None
    matched_by: str
    """How the joints were told apart, in words."""


def match_joints(
    names: Sequence[str],
    parents: Sequence[int],
    bones: Float[Tensor, "j 3"],
    positions: Float[Tensor, "f j 3"],
) -> JointMatch | list[str]:
    """Return the figure, or else what could not be placed.

    Args:
        names: The joints' names.
        parents: Their parents, each before its children.
        bones: Their places relative to their parents, in the parent's axes, any unit.
        positions: Where they are in some frames; tells left from right where names do not.
    """
    missing, limbs = _limbs_by_name(names, parents)
    matched_by = "names"
    if missing:
        limbs = _limbs_by_shape(names, parents, bones, positions)
        matched_by = "hierarchy and lengths"
    if limbs is None:
        return missing
    pelvis = _common_ancestor(parents, [limbs["left_hip"], limbs["right_hip"]])
    chest = _common_ancestor(parents, [limbs["left_shoulder"], limbs["right_shoulder"]])
    trunk = _path(parents, chest, pelvis)
    if trunk is None or pelvis in limbs.values() or chest in limbs.values():
        return ["a trunk from legs to arms"]
    for side in SIDES:
        direction = _path(parents, limbs[f"{side}_shoulder"], chest)
        if direction and len(direction) > 2:
            limbs[f"{side}_collar"] = direction[1]
        toes = _toes(names, parents, bones, limbs[f"{side}_ankle"])
        if toes is not None:
            limbs[f"{side}_foot"] = toes
    head = _head(names, parents, bones, chest, [limbs[f"{side}_shoulder"] for side in SIDES])
    neck = () if head is None else (_path(parents, head, chest) or ())[1:-1]
    return JointMatch(limbs, trunk, neck, head, matched_by)


def _limbs_by_name(names: Sequence[str], parents: Sequence[int]) -> tuple[list[str], dict[str, int] | None]:
    """Return what lacks, and the limbs' joints where nothing does."""
    sided: dict[tuple[str, str], int] = {}
    for index, (side, word) in enumerate(_plain_names(names)):
        sided.setdefault((side, word), index)
    limbs, missing = {}, []
    for side in SIDES:
        for chain in _CHAINS:
            chain_joints = {}
            for joint in chain:
                index = next((sided[side, word] for word in _WORDS[joint] if (side, word) in sided), None)
                if index is None:
                    missing.append(f"{side} {joint}")
                else:
                    chain_joints[joint] = index
            direction = [chain_joints[joint] for joint in chain if joint in chain_joints]
            for upper, lower in pairwise(direction):
                if upper == lower or _path(parents, lower, upper) is None:
                    missing.append(f"{names[lower]} below {names[upper]}")
            limbs |= {f"{side}_{joint}": index for joint, index in chain_joints.items()}
    return missing, None if missing else limbs


def _plain_names(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the side and the rest of each name in small letters, without the prefix that all share."""
    tokens = [re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", re.sub(r"^.*[:|]", "", name)) for name in names]
    while all(len(each) > 1 for each in tokens) and len({each[0].lower() for each in tokens}) == 1:
        tokens = [each[1:] for each in tokens]
    for each in tokens:
        words = [token.lower() for token in each]
        side = ""
        for word in list(words):
            glued = next((name for name in SIDES if word.startswith(name)), None)
            if word in ("l", "r") or glued:
                side = glued or {"l": "left", "r": "right"}[word]
                words[words.index(word)] = word.removeprefix(glued) if glued else ""
                break
        yield side, re.sub(r"(?<=\D)0*1?$", "", "".join(words))


def _limbs_by_shape(
    names: Sequence[str],
    parents: Sequence[int],
    bones: Float[Tensor, "j 3"],
    positions: Float[Tensor, "f j 3"],
) -> dict[str, int] | None:
    """Return the limbs' joints of a figure with two pairs of equal limbs, one pair on each end of a trunk."""
    lengths = bones.norm(dim=1).tolist()
    chains = _longest_chains(parents, lengths)
    limbs = {joint: found for joint, chain in chains.items() if (found := _limb_joints(lengths, chain))}
    spans = {joint: sum(lengths[each] for each in chains[joint][1:]) for joint in limbs}
    longest = max(spans.values(), default=0.0)
    pairs = [
        pair
        for pair in combinations(sorted(limbs), 2)
        if parents[pair[0]] == parents[pair[1]]
        and min(spans[joint] for joint in pair) > _LIMB * longest
        and abs(spans[pair[0]] - spans[pair[1]]) < _ALIKE * longest
    ]
    if len(pairs) != 2 or parents[pairs[0][0]] == parents[pairs[1][0]]:
        return None
    legs, arms = sorted(pairs, key=lambda pair: parents[pair[0]])
    trunk = positions[:, parents[arms[0]]] - positions[:, parents[legs[0]]]
    toes = [positions[:, chains[leg][-1]] - positions[:, limbs[leg][2]] for leg in legs]
    leftward = torch.linalg.cross(trunk, toes[0] + toes[1])
    found = {}
    for pair, chain in ((legs, _CHAINS[0]), (arms, _CHAINS[1])):
        sides = [side for side, _ in _plain_names(names[joint] for joint in pair)]
        if set(sides) != set(SIDES):
            first, second = (positions[:, limbs[joint][0]] for joint in pair)
            across = float(((first - second) * leftward).sum(-1).mean())
            if not across:
                return None
            sides = SIDES if across > 0 else SIDES[::-1]
        for side, joint in zip(sides, pair, strict=True):
            found |= {f"{side}_{name}": index for name, index in zip(chain, limbs[joint], strict=True)}
    return found


def _longest_chains(parents: Sequence[int], lengths: Sequence[float]) -> dict[int, tuple[int, ...]]:
    """Return by joint the longest way down from it, starting with itself."""
    chains: dict[int, tuple[int, ...]] = {}
    spans = dict.fromkeys(range(len(parents)), 0.0)
    for joint in reversed(range(len(parents))):
        children = [child for child, parent in enumerate(parents) if parent == joint]
        best = max(children, key=lambda child: spans[child] + lengths[child], default=None)
        chains[joint] = (joint,) if best is None else (joint, *chains[best])
        spans[joint] = 0.0 if best is None else spans[best] + lengths[best]
    return chains


def _limb_joints(lengths: Sequence[float], chain: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return where a limb's two long bones begin, meet and end; None where there are no such two."""
    ends = sorted(sorted(range(1, len(chain)), key=lambda position: lengths[chain[position]])[-2:])
    if len(ends) < 2 or ends[1] != ends[0] + 1:
        return None
    upper, lower = (lengths[chain[end]] for end in ends)
    before = sum(lengths[joint] for joint in chain[1 : ends[0]])
    if not 0.6 * upper < lower < 1.6 * upper or before > upper:
        return None
    return chain[ends[0] - 1], chain[ends[0]], chain[ends[1]]


def _toes(
    names: Sequence[str], parents: Sequence[int], bones: Float[Tensor, "j 3"], ankle: int
) -> int | None:
    children = [
        child
        for child, parent in enumerate(parents)
        if parent == ankle and not any(word in names[child].lower() for word in _NOT_TOES)
    ]
    named = [child for child in children if any(word in names[child].lower() for word in _TOES)]
    return max(named or children, key=lambda child: float(bones[child].norm()), default=None)


def _head(
    names: Sequence[str], parents: Sequence[int], bones: Float[Tensor, "j 3"], chest: int, arms: list[int]
) -> int | None:
    """Return the joint named head, else the last but one above the chest that belongs to no arm."""
    above = [joint for joint in range(len(names)) if _path(parents, joint, chest) and joint != chest]
    for joint, (_, word) in enumerate(_plain_names(names)):
        if word == "head" and joint in above:
            return joint
    arms = [(_path(parents, arm, chest) or (arm,) * 2)[1] for arm in arms]
    chains = _longest_chains(parents, bones.norm(dim=1).tolist())
    children = [joint for joint in above if parents[joint] == chest and joint not in arms]
    best = max(
        children, key=lambda child: sum(float(bones[each].norm()) for each in chains[child]), default=None
    )
    if best is None:
        return None
    return chains[best][min(1, len(chains[best]) - 1)]


def _path(parents: Sequence[int], below: int, above: int) -> tuple[int, ...] | None:
    """Return the joints from one down to another, both included; None where it is not below."""
    direction = [below]
    while direction[-1] != above:
        if parents[direction[-1]] < 0:
            return None
        direction.append(parents[direction[-1]])
    return tuple(direction[::-1])


def _common_ancestor(parents: Sequence[int], joints: Sequence[int]) -> int:
    """Return the last joint that all hang below."""
    directions = []
    for joint in joints:
        direction = {joint}
        while joint >= 0:
            direction.add(joint)
            joint = parents[joint]
        directions.append(direction)
    return max(set.intersection(*directions))
