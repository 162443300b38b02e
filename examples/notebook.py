# %% [markdown]
# Two controllers in a notebook. Jupyter and Visual Studio Code take the cells of this file as they
# stand; as a script it runs from top to bottom: python examples/notebook.py

# %% A scenario, and what differs
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ffsm_drake

scenario = ffsm_drake.load_scenario("flight_sensors", [{"duration": 8, "random_seed": 3}])
print(scenario)

# %% Will it settle? Without simulating
print(ffsm_drake.stability(scenario).verdict)

# %% Two runs
records = {
    name: ffsm_drake.simulate(scenario.replace(controller=name), check_stability=False)
    for name in ("tde_aismc", "tdc")
}
print(*records.values(), sep="\n")

# %% Every signal by name
error = records["tdc"].dataset["error"]
print(error.sel(coordinate="joint_2").sel(time=3.0, method="nearest").item(), "rad")
print(records["tdc"].positions())

# %% A picture
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for name, record in records.items():
    joint = np.abs(record.dataset["error"].sel(coordinate="joint_2"))
    axes.semilogy(joint["time"], joint, label=name, linewidth=0.8)
axes.set(xlabel="time [s]", ylabel="error of joint_2 [rad]")
axes.legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/notebook.png")

# %% The same as a page, with the motion
ffsm_drake.write_outputs(list(records.values()), "out/notebook", figures=False)
