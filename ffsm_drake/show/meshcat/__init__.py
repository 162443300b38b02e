"""Meshcat: the stage, the recorded page, and the live replay with its controls."""

from ffsm_drake.show.meshcat.live import LiveReplay, replay_live
from ffsm_drake.show.meshcat.recording import recording_html, write_recording
from ffsm_drake.show.meshcat.stage import quiet_drake, set_stage, start_meshcat

__all__ = [
    "LiveReplay",
    "quiet_drake",
    "recording_html",
    "replay_live",
    "set_stage",
    "start_meshcat",
    "write_recording",
]
