"""IN: cameras, lazily decoded streams, dataset readers, and the checks made when they are loaded."""

from mvdyn_gtsam.capture.convert import write_capture
from mvdyn_gtsam.capture.dispatch import open_capture
from mvdyn_gtsam.capture.euroc import load_euroc
from mvdyn_gtsam.capture.focal import with_unknown_focal
from mvdyn_gtsam.capture.folder_per_camera import load_folder_per_camera
from mvdyn_gtsam.capture.loader import capture_from_cameras, load_capture
from mvdyn_gtsam.capture.model import FIRST_FOCAL, Camera, Capture, FrameStream
from mvdyn_gtsam.capture.multicamvideo import convert_multicamvideo, load_multicamvideo, multicamvideo_poses
from mvdyn_gtsam.capture.streams import ImageStream, UndistortedStream, VideoStream

__all__ = [
    "FIRST_FOCAL",
    "Camera",
    "Capture",
    "FrameStream",
    "ImageStream",
    "UndistortedStream",
    "VideoStream",
    "capture_from_cameras",
    "convert_multicamvideo",
    "load_capture",
    "load_euroc",
    "load_folder_per_camera",
    "load_multicamvideo",
    "multicamvideo_poses",
    "open_capture",
    "with_unknown_focal",
    "write_capture",
]
