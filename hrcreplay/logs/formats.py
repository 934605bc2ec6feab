"""The file formats that ``import`` reads into a log, in one table. Loads pandas, so only ``import`` loads it."""

from __future__ import annotations

from collections.abc import Mapping

from hrcreplay.logs.dataset_files import read_chico, read_harper
from hrcreplay.logs.mocap_files import read_bvh, read_c3d, read_mvnx, read_optitrack, read_trc
from hrcreplay.logs.motion_files import Format
from hrcreplay.logs.table_files import read_mediapipe, read_table
from hrcreplay.logs.tracker_files import read_k4abt, read_ntu, read_openpose, read_zed

_NAMED = ("names", "plug_in_gait", "bvh", "optitrack", "xsens")

#: Kind -> format. azure, kinect2 and keraal have functions of their own in ``importers``.
FORMATS: Mapping[str, Format] = {
    "table": Format(_NAMED, read_table),
    "mediapipe": Format(("mediapipe",), read_mediapipe),
    "openpose": Format(("body25",), read_openpose),
    "k4abt": Format(("names",), read_k4abt),
    "zed": Format(("zed38",), read_zed),
    "trc": Format(_NAMED, read_trc),
    "c3d": Format(_NAMED, read_c3d),
    "bvh": Format(("bvh", "names"), read_bvh),
    "optitrack": Format(("optitrack", "bvh", "names"), read_optitrack),
    "mvnx": Format(("xsens",), read_mvnx),
    "ntu": Format(("names",), read_ntu),
    "chico": Format(("chico",), read_chico),
    "harper": Format(("harper",), read_harper),
}
