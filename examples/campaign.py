"""A few dispersed cases, the same for two controllers. From the shell, with the specification in a
file:

ffsm campaign run spec.yaml --database out/campaign/runs.db
ffsm campaign report out/campaign/runs.db
"""

import shutil
from pathlib import Path

import ffsm_drake
from ffsm_drake.plugins.campaign import open_store

SPEC = """
description: Captured mass and its nominal value
scenario: postcapture
controllers: [tdc, asmc]
cases: 8
overrides: {duration: 2.0, reference.duration: 1.5}
parameters:
  payload.truth.mass: {distribution: uniform, low: 50, high: 200}
factors:
  nominal_error: {distribution: uniform, low: -0.5, high: 0.2}
derive:
  payload.truth.inertia: {rule: solid_cube, mass: payload.truth.mass, side: 1.0}
  payload.nominal.mass: {rule: relative, of: payload.truth.mass, error: nominal_error}
  payload.nominal.inertia: {rule: relative, of: payload.truth.inertia, error: nominal_error}
"""


def main():
    folder = Path("out/campaign")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "spec.yaml").write_text(SPEC)
    database = ffsm_drake.run_campaign(folder / "spec.yaml", folder / "runs.db", workers=2)
    with open_store(database) as store:
        for controller, outcome, number in store.query(
            "SELECT controller, outcome, count(*) FROM results GROUP BY controller, outcome"
        ):
            print(f"{controller}: {number} {outcome}")
        store.export(folder / "runs.csv")


if __name__ == "__main__":  # the workers import this file
    main()
