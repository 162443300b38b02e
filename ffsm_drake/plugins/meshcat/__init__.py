"""The spacecraft in Meshcat: a page that plays back a run, and the stage of live views.

solids, stage (server, camera, spacecraft) -> arrows, drift -> replay_view (a run's samples) ->
recording (the page)
"""
