import dataclasses
import os
import sys
import threading
import time

import numpy as np
from pydrake.systems.framework import LeafSystem

from ffsm_drake import ControlLaw, PlantModel, gain
from ffsm_drake.systems.controllers.laws.tdc import Tdc


@dataclasses.dataclass(frozen=True)
class Good(ControlLaw):
    k: np.ndarray = gain(1.0)

    def step(self, sample, state):
        return 0.0 * sample.v, {}


class NanForce(Good):
    def step(self, sample, state):
        return np.full(sample.v.size, np.nan), {}


@dataclasses.dataclass(frozen=True)
class NanState(ControlLaw):
    model: PlantModel

    def step(self, sample, state):
        self.model.calc_mass_matrix(sample.q * np.nan)


class WrongSize(Good):
    def step(self, sample, state):
        return np.zeros(3), {}


class ReturnsNone(Good):
    def step(self, sample, state):
        pass


class OnlyForce(Good):
    def step(self, sample, state):
        return 0.0 * sample.v


class TextForce(Good):
    def step(self, sample, state):
        return ["much"] * sample.v.size, {}


class Forgets(Good):
    def initial_state(self):
        return {"integral": np.zeros(3)}


class Invents(Good):
    def step(self, sample, state):
        return 0.0 * sample.v, {"integral": sample.v}


class ListMemory(Good):
    def initial_state(self):
        return [np.zeros(3)]


class Raises(Good):
    def step(self, sample, state):
        return {}["gain"]


class Leaves(Good):
    def step(self, sample, state):
        sys.exit(0)


class Inf(Good):
    def initial_state(self):
        return {"samples": np.zeros(1)}

    def step(self, sample, state):
        force = 0.0 * sample.v
        force[3] = np.inf if state["samples"] == 2 else 0.0
        return force, {"samples": state["samples"] + 1}


class Large(Inf):
    def step(self, sample, state):
        return np.full(sample.v.size, 1e308), {"samples": state["samples"]}


class Mute(Exception):
    def __str__(self):
        raise RuntimeError("not even this")


class RaisesMute(Good):
    def step(self, sample, state):
        raise Mute


class RaisesExit(Good):
    def step(self, sample, state):
        raise GeneratorExit("gone")


class ExitsAtOnce(Good):
    def __init__(self, **gains):
        raise GeneratorExit("gone")


class Elsewhere(Good):
    def step(self, sample, state):
        os.chdir("/")
        return 0.0 * sample.v, {}


class LeavesThread(Good):
    def step(self, sample, state):
        if threading.active_count() == 1:
            threading.Thread(target=time.sleep, args=(300,), name="mine").start()
        return 0.0 * sample.v, {}


def needs_setting(setup):
    return Good(k=setup.settings["gain"])


class SmallMatrix:
    def calc_mass_matrix(self, q):
        return np.eye(3)


def small_matrix(setup):
    return dataclasses.replace(Tdc.from_setup(setup), model=SmallMatrix())


class NoLaw(ControlLaw):
    pass


@dataclasses.dataclass(frozen=True)
class RaisesAtOnce(Good):
    def __post_init__(self):
        raise OSError("no table of gains")


class NoSuperInit(LeafSystem):
    def __init__(self, setup):
        self.table = {}


@dataclasses.dataclass(frozen=True)
class TextGain(Good):
    k: np.ndarray = gain("high")


class ShortGain(Good):
    def initial_state(self):
        return {"switching_gain": np.zeros(3)}


class NoPorts(LeafSystem):
    def __init__(self, setup):
        super().__init__()


class WrongPortSize(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 4)
        self.DeclareVectorInputPort("desired_state", 23)
        self.DeclareVectorInputPort("desired_acceleration", 11)
        self.DeclareVectorOutputPort("generalized_force", 11, lambda context, output: None)


class StrangePort(WrongPortSize):
    def __init__(self, setup):
        super().__init__(setup)
        self.DeclareVectorInputPort("estimate", 4)


class Loop(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 23)
        self.DeclareVectorInputPort("desired_state", 23)
        self.DeclareVectorInputPort("desired_acceleration", 11)
        self.DeclareVectorInputPort("applied_force", 11)
        self.DeclareVectorOutputPort("generalized_force", 11, lambda context, output: None)


def returns_none(setup):
    return None


table = {"k": 1}
