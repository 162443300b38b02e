"""A self-contained page that plays back a record."""

import html
import math
from pathlib import Path
from typing import Any

from ffsm_drake.common.files import write_text
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.meshcat.arrows import ARROW_KINDS, legend
from ffsm_drake.plugins.meshcat.replay_view import FRAMES_PER_SECOND, ReplayView, check_speed
from ffsm_drake.plugins.meshcat.stage import start_meshcat
from ffsm_drake.runs.record import RunRecord

# Covers the empty scene until the motion is in; before the scripts, to show while they load.
_LOADING = """<style>
#loading { position: fixed; inset: 0; z-index: 99999; display: grid; place-items: center;
  background: #0a0d16; color: #9fb0cc; font: 15px sans-serif; }
</style>
<div id="loading">Loading the motion \u2026</div>
"""
# ``viewer`` is a global name of Drake's page. The page plays at once, but embedded in another it
# shows its first frame. Meshcat's own panel is collapsed, hence the bar.
_CAPTION = """<style>
#caption, #bar {{ position: fixed; left: 12px; padding: 8px 12px; border-radius: 6px;
  background: rgba(5, 8, 20, .72); color: #e8ecf6; font: 13px/1.5 sans-serif; }}
#caption {{ bottom: 62px; max-width: 60ch; pointer-events: none; }}
#caption label {{ pointer-events: auto; cursor: pointer; }}
#bar {{ bottom: 12px; right: 12px; display: flex; gap: 12px; align-items: center; }}
#bar input {{ flex: 1; min-width: 0; }}
#bar output {{ font-variant-numeric: tabular-nums; }}
#play {{ width: 96px; padding: 5px; border-radius: 99px; border: 1px solid #5a6a8c;
  background: #141c30; color: #fff; font: inherit; cursor: pointer; }}
@media (max-width: 700px) {{ #caption {{ font-size: 11px; }} }}
</style>
<div id="caption">{lines}</div>
<div id="bar"><button id="play" type="button"></button>
<input id="time" type="range" min="0" max="{end}" step="any" value="0" aria-label="Time, s">
<output id="clock"></output>
<select id="rate" aria-label="Multiple of real time">{rates}</select></div>
<script>
  (() => {{
    const [button, slider, clock, rate, cover] = ["play", "time", "clock", "rate", "loading"].map(
      (id) => document.getElementById(id));
    const player = () => viewer.animator;
    let begun = window !== window.parent, frames = 0;
    button.onclick = () => player().playing ? player().pause() : player().play();
    slider.oninput = () => {{
      player().play();
      player().pause();
      player().seek(slider.value / {speed});
      player().display_progress(slider.value / {speed});
    }};
    rate.onchange = () => {{ player().mixer.timeScale = rate.value / {speed}; }};
    addEventListener("keydown", (event) => {{
      if (event.code !== "Space" || event.target.closest("input, select, button")) return;
      event.preventDefault();
      button.click();
    }});
    for (const box of document.querySelectorAll("#caption input")) {{
      box.onchange = () => {{
        const path = "/drake/" + box.value;
        const change = {{ type: "set_property", path, property: "visible", value: box.checked }};
        viewer.handle_command(change);
        viewer.set_dirty();
      }};
    }}
    const fit = () => {{
      viewer.camera.zoom = Math.min(1, 0.75 * innerWidth / innerHeight);
      viewer.camera.updateProjectionMatrix();
    }};
    addEventListener("resize", fit);
    (function watch() {{
      const ready = player().actions.length;
      if (ready || ++frames > 600) {{
        if (cover.style.display !== "none") fit();
        cover.style.display = "none";
      }}
      if (!begun && ready) {{ begun = true; player().play(); }}
      const time = Math.min({speed} * player().time, {end});
      slider.value = time;
      clock.textContent = `t = ${{time.toFixed(1)}} of {end:.1f} s`;
      button.textContent = player().playing ? "Pause" : "\u25b6 Play";
      requestAnimationFrame(watch);
    }})();
  }})();
</script>
"""
_RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)  # multiples of real time to choose from
# an arrow's line in the caption: a box that shows or hides the arrow, in its colour
_ARROW = (
    '<label><input type="checkbox" checked value="{path}" style="accent-color:{color}"> '
    "{text}</label>"
)


@step("recording the motion")
def recording_html(
    record: RunRecord,
    *,
    speed: float = 1.0,
    ghost: bool = True,
    path: bool = True,
    forces: bool = False,
) -> str:
    """A self-contained HTML page that plays back a record, without simulation.

    Args:
      record: the run.
      speed: multiple of real time; 2 shows a run of 20 s in 10 s.
      ghost: show the target posture as a translucent ghost.
      path: show the hand's path.
      forces: show control force and torque on the base, and the disturbance, as arrows; a caption
        names them.

    Raises:
      FfsmError: the speed is not positive.
      ModelError: the scenario's model no longer loads.
    """
    check_speed(speed)
    # Slow motion has no more frames than the record has samples; the page interpolates.
    frames_per_second = min(FRAMES_PER_SECOND, speed / record.scenario.sample_time)
    meshcat = start_meshcat()
    view = ReplayView(
        meshcat,
        record,
        ghost=ghost,
        path=path,
        forces=forces,
        frames_per_second=frames_per_second,
        speed=speed,
    )
    view.spacecraft.visualizer.StartRecording(set_transforms_while_recording=False)
    for frame in range(math.ceil(view.duration / speed * frames_per_second - 1e-9) + 1):
        # Drake rounds times down to frames: the middle of a frame is safe from rounding errors.
        view.show(
            frame / frames_per_second * speed, time_in_recording=(frame + 0.5) / frames_per_second
        )
    view.spacecraft.visualizer.StopRecording()
    view.spacecraft.visualizer.get_mutable_recording().set_autoplay(False)
    view.spacecraft.visualizer.PublishRecording()
    return _with_caption(meshcat.StaticHtml(), record, view, speed=speed)


def write_recording(record: RunRecord, file: str | Path, **options: Any) -> None:
    """Write the page of ``recording_html``, with its arguments and errors.

    Raises RecordError if the file cannot be written.
    """
    write_text(Path(file), recording_html(record, **options))


def _with_caption(page: str, record: RunRecord, view: ReplayView, *, speed: float) -> str:
    """Return the page with a title and a caption: run, speed, meaning of the arrows."""
    title = record.scenario.description or "Run"
    lines = [
        f"<b>{html.escape(title)}</b>",
        html.escape(f"{record.scenario.controller}: {record.outcome.message}"),
    ]
    if record.grasp is not None and record.grasp["time"] > 0.0:
        lines.append(f"grasp at t = {record.grasp['time']:g} s")
    if view.magnified:
        lines.append(view.magnified)
    lines += map(html.escape, view.legend)  # with names of the model
    if view.arrows is not None:
        for kind, text in zip(ARROW_KINDS, legend(view.arrows), strict=True):
            color = "rgb({:.0f},{:.0f},{:.0f})".format(*(255 * part for part in kind.color))
            lines.append(_ARROW.format(path=kind.path, color=color, text=html.escape(text)))
        lines.append("All act on the base; torques have two heads.")
    if drawn := view.switched.legend + view.spacecraft.legend:
        lines.append(html.escape("; ".join(drawn)))
    rates = [
        f'<option value="{rate:g}"{" selected" if rate == speed else ""}>{rate:g} x</option>'
        for rate in sorted({*_RATES, speed})
    ]
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{html.escape(title)}</title>", 1)
    page = page.replace("<body>", f"<body>{_LOADING}", 1)
    head, end, tail = page.rpartition("</body>")
    return (
        head
        + _CAPTION.format(
            lines="<br>".join(lines), speed=speed, end=view.duration, rates="".join(rates)
        )
        + end
        + tail
    )
