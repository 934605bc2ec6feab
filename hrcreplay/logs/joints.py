"""Which joint of which tracker is which of our POINTS. What a tracker lacks is left missing."""

from __future__ import annotations

from collections.abc import Mapping

from hrcreplay.records import POINTS

_SIDES = (("l", "LEFT", "Left", "left"), ("r", "RIGHT", "Right", "right"))

#: Azure Kinect Body Tracking: joint index -> name.
AZURE_JOINTS = (
    *("PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK"),
    *("CLAVICLE_LEFT", "SHOULDER_LEFT", "ELBOW_LEFT", "WRIST_LEFT", "HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT"),
    *("CLAVICLE_RIGHT", "SHOULDER_RIGHT", "ELBOW_RIGHT", "WRIST_RIGHT", "HAND_RIGHT", "HANDTIP_RIGHT", "THUMB_RIGHT"),
    *("HIP_LEFT", "KNEE_LEFT", "ANKLE_LEFT", "FOOT_LEFT", "HIP_RIGHT", "KNEE_RIGHT", "ANKLE_RIGHT", "FOOT_RIGHT"),
    *("HEAD", "NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT"),
)

#: Kinect v2: joint index -> name.
KINECT2_JOINTS = (
    *("SpineBase", "SpineMid", "Neck", "Head"),
    *("ShoulderLeft", "ElbowLeft", "WristLeft", "HandLeft", "ShoulderRight", "ElbowRight", "WristRight", "HandRight"),
    *("HipLeft", "KneeLeft", "AnkleLeft", "FootLeft", "HipRight", "KneeRight", "AnkleRight", "FootRight"),
    *("SpineShoulder", "HandTipLeft", "ThumbLeft", "HandTipRight", "ThumbRight"),
)

_PAIRED = ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "foot")

#: POINTS -> joint of the Azure Kinect.
AZURE_POINTS: Mapping[str, str] = {"pelvis": "PELVIS", "chest": "SPINE_CHEST", "neck": "NECK", "head": "HEAD"} | {
    f"{joint}_{s}": f"{joint.upper()}_{side}" for joint in _PAIRED for s, side, _, _ in _SIDES
}

#: POINTS -> joint of the Kinect v2. Its Neck lies above the shoulder line, where our neck is.
KINECT2_POINTS: Mapping[str, str] = {
    "pelvis": "SpineBase",
    "chest": "SpineMid",
    "neck": "SpineShoulder",
    "head": "Head",
} | {f"{joint}_{s}": f"{joint.title()}{side}" for joint in _PAIRED for s, _, side, _ in _SIDES}

#: POINTS -> frame of openni_tracker, taken as named: OpenNI may mirror left and right, which no log tells.
#: It has no ankle (its foot is the ankle's place) and no wrist: the hand stands for the wrist, or no forearm could
#: be seen. The pelvis is the middle of its hips.
OPENNI_POINTS: Mapping[str, str] = {"chest": "torso", "neck": "neck", "head": "head"} | {
    f"{point}_{s}": f"{side}_{joint}"
    for point, joint in (
        *(("shoulder", "shoulder"), ("elbow", "elbow"), ("wrist", "hand"), ("hand", "hand")),
        *(("hip", "hip"), ("knee", "knee"), ("foot", "foot")),
    )
    for s, _, _, side in _SIDES
}

#: Joints that openni_tracker publishes of a person, without the trailing id.
OPENNI_JOINTS = frozenset(OPENNI_POINTS.values())

#: Azure Kinect joint index -> index into POINTS.
AZURE_INDEX: Mapping[int, int] = {
    AZURE_JOINTS.index(joint): POINTS.index(point) for point, joint in AZURE_POINTS.items()
}

#: Kinect v2 joint index -> index into POINTS.
KINECT2_INDEX: Mapping[int, int] = {
    KINECT2_JOINTS.index(joint): POINTS.index(point) for point, joint in KINECT2_POINTS.items()
}
