"""FMUs in the hands of FMPy."""

import fmpy
import numpy as np
from fmpy.fmi3 import FMU3Slave


class Driven:
    """An instance of an FMU, and its variables by group."""

    def __init__(self, path, folder, *, begun=True, **parameters):
        description = fmpy.read_model_description(str(path), validate=True)
        self.variables = {v.name: v for v in description.modelVariables}
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.messages = []
        if not (folder / "modelDescription.xml").exists():
            fmpy.extract(str(path), unzipdir=str(folder))
        self.fmu = FMU3Slave(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=path.stem,
        )
        self.fmu.instantiate(
            loggingOn=True, logMessage=lambda *told: self.messages.append(told[-1])
        )
        self.set_parameters(**parameters)
        if begun:
            self.begin()

    def set_parameters(self, **values):
        for name, value in values.items():
            kind = "Int64" if name == "seed" else "Float64"
            kind = "Boolean" if isinstance(value, bool) else kind
            getattr(self.fmu, f"set{kind}")([self.references[name]], [value])

    def begin(self, start=0.0):
        self.fmu.enterInitializationMode(startTime=start)
        self.fmu.exitInitializationMode()

    def of(self, group):
        return [r for name, r in self.references.items() if name.startswith(f"{group}.")]

    def get(self, group):
        return np.array(self.fmu.getFloat64(self.of(group)))

    def wholes(self):
        """Status, causes and warnings."""
        return self.fmu.getUInt32([self.references[n] for n in ("status", "causes", "warnings")])

    def end(self):
        self.fmu.terminate()
        self.fmu.freeInstance()
