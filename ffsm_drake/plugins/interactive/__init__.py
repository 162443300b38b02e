"""Live runs, an operator's panel and replays in the browser."""
