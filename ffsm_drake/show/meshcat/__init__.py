"""Meshcat: the stage and the recorded page."""

from ffsm_drake.show.meshcat.recording import recording_html, write_recording
from ffsm_drake.show.meshcat.stage import quiet_drake, set_stage, start_meshcat

__all__ = [
    "quiet_drake",
    "recording_html",
    "set_stage",
    "start_meshcat",
    "write_recording",
]
