"""The body that carries the Gaussians, as UsdSkel: a skeleton, its motion and a skinned mesh.

Imports pxr: only the writers of an asset import this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from dsar.geometry.rotations import quaternion_from_matrix
from dsar.types import Binding, Body
from dsar_exporters.usd.influences import largest_influences
from dsar_exporters.usd.timeline import Timeline

BODY, MESH = "body", "mesh"
_INFLUENCES = 8
"""Joints of a vertex, the largest ones: what engines take."""
_GREY = 0.5


class BodyWriter:
    """A SkelRoot whose skeleton moves like the body that drove the rollout.

    The mesh has no pose blend shapes, as the avatar's own skinning has none.
    """

    def __init__(self, stage: Usd.Stage, timeline: Timeline, binding: Binding) -> None:
        self._timeline, self._binding = timeline, binding
        body = binding.body
        self._influences = largest_influences(body.weights, _INFLUENCES)
        self._rotations = np.zeros((len(body.joints), 4))
        points = body.vertices.float().numpy()
        self._boxes, self._carries = _boxes(points, *self._influences, len(body.joints))
        self._root = UsdSkel.Root.Define(stage, f"/{BODY}")
        self._define_skeleton(stage)
        self._define_mesh(stage)

    def _define_skeleton(self, stage: Usd.Stage) -> None:
        binding, path = self._binding, self._root.GetPath()
        joints = Vt.TokenArray(joint_paths(binding.joint_names, binding.body.parents))
        skeleton = UsdSkel.Skeleton.Define(stage, path.AppendChild("skeleton"))
        self._motion = UsdSkel.Animation.Define(stage, skeleton.GetPath().AppendChild("motion"))
        rest = _joint_frames(binding.body, np.tile(np.eye(4), (len(joints), 1, 1)))
        skeleton.CreateJointsAttr(joints)
        skeleton.CreateBindTransformsAttr(_matrices(rest))
        skeleton.CreateRestTransformsAttr(_matrices(_relative_to_parents(rest, binding.body.parents)))
        self._motion.CreateJointsAttr(joints)
        self._motion.CreateScalesAttr(Vt.Vec3hArray.FromNumpy(np.ones((len(joints), 3), np.float16)))
        bound = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
        bound.CreateAnimationSourceRel().SetTargets([self._motion.GetPath()])
        self._skeleton = skeleton

    def _define_mesh(self, stage: Usd.Stage) -> None:
        body = self._binding.body
        mesh = UsdGeom.Mesh.Define(stage, self._root.GetPath().AppendChild(MESH))
        vertices, faces = body.vertices.float().contiguous().numpy(), body.faces.int().contiguous().numpy()
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
        mesh.CreateDisplayColorAttr([Gf.Vec3f(_GREY)])
        primvars = UsdGeom.PrimvarsAPI(mesh)
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(body.uv.float().contiguous().numpy()))
        st.SetIndices(Vt.IntArray.FromNumpy(body.uv_faces.int().contiguous().numpy().ravel()))
        indices, weights = self._influences
        bound = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        bound.CreateSkeletonRel().SetTargets([self._skeleton.GetPath()])
        bound.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
        bound.CreateJointIndicesPrimvar(False, indices.shape[1]).Set(Vt.IntArray.FromNumpy(indices.ravel()))
        bound.CreateJointWeightsPrimvar(False, weights.shape[1]).Set(Vt.FloatArray.FromNumpy(weights.ravel()))

    def write(self, frame: int, index: int) -> None:
        """Write the joints of a frame, the binding's `index`-th."""
        body, transforms = self._binding.body, self._binding.T_world_rest[index].double().numpy()
        local = _relative_to_parents(_joint_frames(body, transforms), body.parents)
        quaternions = quaternion_from_matrix(torch.from_numpy(local[:, :3, :3])).numpy()
        # The short way from the frame before, for applications that interpolate numbers and not rotations.
        quaternions = np.where(
            (quaternions * self._rotations).sum(-1, keepdims=True) < 0, -quaternions, quaternions
        )
        self._rotations = quaternions
        rotations = Vt.QuatfArray.FromNumpy(quaternions[:, [1, 2, 3, 0]].astype(np.float32))
        translations = Vt.Vec3fArray.FromNumpy(local[:, :3, 3].astype(np.float32))
        extent = Vt.Vec3fArray.FromNumpy(self._bounds(transforms))
        self._timeline.sample(self._motion.CreateTranslationsAttr(), frame, translations)
        self._timeline.sample(self._motion.CreateRotationsAttr(), frame, rotations)
        self._timeline.sample(self._root.CreateExtentAttr(), frame, extent)

    def _bounds(self, transforms: Float64[np.ndarray, "j 4 4"]) -> Float32[np.ndarray, "2 3"]:
        """Return corners that hold the skinned mesh, metres.

        A vertex lies among the places to which its joints would carry it, so that the boxes of what each
        joint holds at rest, carried, hold the mesh; up to decimetres more than it needs.
        """
        boxes = self._boxes @ transforms[:, :3, :3].swapaxes(1, 2) + transforms[:, None, :3, 3]
        points = boxes[self._carries].reshape(-1, 3)
        return np.stack([points.min(0), points.max(0)]).astype(np.float32)


def _boxes(
    points: Float32[np.ndarray, "v 3"], indices: np.ndarray, weights: Float32[np.ndarray, "v c"], joints: int
) -> tuple[Float64[np.ndarray, "j 8 3"], Bool[np.ndarray, " j"]]:
    """Return the corners of the box about the vertices of each joint, and which joints have any."""
    corners, carries = np.zeros((joints, 8, 3)), np.zeros(joints, bool)
    for joint in range(joints):
        carried = points[((indices == joint) & (weights > 0)).any(1)]
        if len(carried):
            box, carries[joint] = (carried.min(0), carried.max(0)), True
            corners[joint] = [[box[i][0], box[j][1], box[k][2]] for i, j, k in np.ndindex(2, 2, 2)]
    return corners, carries


def joint_paths(names: tuple[str, ...], parents: tuple[int, ...]) -> list[str]:
    """Return each joint's path from the root, as UsdSkel names joints."""
    paths: list[str] = []
    for name, parent in zip(names, parents, strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return paths


def _joint_frames(body: Body, T_world_rest: Float64[np.ndarray, "j 4 4"]) -> Float64[np.ndarray, "j 4 4"]:
    """Return T_world_joint: joints' own axes are the world's at rest."""
    frames = T_world_rest.copy()
    joints = body.joints.double().numpy()
    frames[:, :3, 3] += (T_world_rest[:, :3, :3] @ joints[..., None])[..., 0]
    return frames


def _relative_to_parents(
    frames: Float64[np.ndarray, "j 4 4"], parents: tuple[int, ...]
) -> Float64[np.ndarray, "j 4 4"]:
    """Return rigid frames as seen from those of their parents."""
    above = np.stack([np.eye(4) if parent < 0 else frames[parent] for parent in parents])
    local, back = np.zeros_like(frames), above[:, :3, :3].swapaxes(1, 2)
    local[:, :3, :3] = back @ frames[:, :3, :3]
    local[:, :3, 3] = (back @ (frames[:, :3, 3] - above[:, :3, 3])[..., None])[..., 0]
    local[:, 3, 3] = 1
    return local


def _matrices(frames: Float64[np.ndarray, "j 4 4"]) -> Vt.Matrix4dArray:
    """Return transforms as USD's row-vector matrices."""
    return Vt.Matrix4dArray([Gf.Matrix4d(frame.T.tolist()) for frame in frames])
