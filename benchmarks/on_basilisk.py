"""(d) of rollout.py: the loop on Basilisk (https://avslab.github.io/basilisk/), which ``pip install
bsk`` brings.
"""

import time
from collections.abc import Generator
from importlib.metadata import version

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import arrayMotorTorqueToSingleActuators, mujoco, svIntegrators
from Basilisk.utilities import SimulationBaseClass, macros
from on_mujoco import Arm, NumpyLaw

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates

VERSION = version("bsk")


class Controller(sysModel.SysModel):
    """The law as a module: the state of the scene in, all forces out."""

    def __init__(
        self, scene: mujoco.MJScene, law: Generator[np.ndarray, tuple[np.ndarray, np.ndarray]]
    ) -> None:
        super().__init__()
        self.law = law
        self.state = messaging.MJSceneStateMsgReader()
        self.state.subscribeTo(scene.stateOutMsg)
        self.forces = messaging.ArrayMotorTorqueMsg()

    def Reset(self, time: int) -> None:
        next(self.law)

    def UpdateState(self, time: int) -> None:
        state, payload = self.state(), messaging.ArrayMotorTorqueMsgPayload()
        qpos, qvel = (
            np.array([number for (number,) in column]) for column in (state.qpos, state.qvel)
        )
        payload.motorTorque = self.law.send((qpos, qvel)).tolist()
        self.forces.write(payload, time, self.moduleID)


class BasiliskLoop:
    """(d)."""

    def __init__(self, scenario: Scenario, coordinates: Coordinates) -> None:
        self.law = NumpyLaw(scenario, coordinates)
        self.joints = len(coordinates.joints)
        self.mjcf = Arm.of(self.joints).mjcf(scenario.payload.truth, actuated=True)

    def run(self, noise: np.ndarray) -> tuple[float, np.ndarray]:
        """Processor time of the run proper, s, and the error (n, nv) at every sample; for
        ``noise`` see the law.
        """
        period = macros.sec2nano(self.law.period)
        simulation = SimulationBaseClass.SimBaseClass()
        simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", period))
        scene = mujoco.MJScene(self.mjcf)
        scene.setIntegrator(svIntegrators.svIntegratorRK4(scene))
        controller, recorder = (
            Controller(scene, self.law.samples(noise)),
            scene.stateOutMsg.recorder(),
        )
        # One message in Python and a module that deals it out take half the time of a message for
        # each actuator.
        actuators = [
            *(f"base_{i}" for i in range(1, 7)),
            *(f"joint_{i}" for i in range(1, self.joints + 1)),
        ]
        dealer = arrayMotorTorqueToSingleActuators.ArrayMotorTorqueToSingleActuators(len(actuators))
        dealer.torqueInMsg.subscribeTo(controller.forces)
        for i, name in enumerate(actuators):
            scene.getSingleActuator(name).actuatorInMsg.subscribeTo(dealer.actuatorOutMsgs[i])
        # the highest comes first
        for priority, model in enumerate((recorder, dealer, controller, scene)):
            simulation.AddModelToTask("task", model, ModelPriority=priority)
        simulation.InitializeSimulation()
        position, (w, *xyz), angles = np.split(self.law.start, [3, 7])
        base = scene.getBody("base")
        base.setPosition(position)
        base.setAttitude(np.array(xyz) / (1.0 + w))  # modified Rodrigues parameters
        for i, angle in enumerate(angles.tolist(), start=1):
            scene.getBody(f"link_{i}").getScalarJoint(f"joint_{i}").setPosition(angle)
        simulation.ConfigureStopTime((len(noise) - 1) * period)
        start = time.process_time()
        simulation.ExecuteSimulation()
        return time.process_time() - start, self.law.errors
