# Skeleton of a component of F Prime around the law. A rate group makes control samples: the last
# measurement goes through law_step, and the force goes out at forceOut. TO DO marks what you fill in:
#
# 1. NQ and NV, as LAW_NQ and LAW_NV in the law's header (the C++ code compares them)
# 2. in your topology, a rate group of LAW_SAMPLE_TIME at schedIn
# 3. navigation at measurementIn, and guidance at referenceIn if LAW_HAS_REFERENCE is 0
# 4. actuators at forceOut; they answer at appliedIn with the force that they applied
# 5. the gripper at targetIn, if LAW_HAS_CAPTURE is 1
# 6. what your mission does at LAW_ZERO, such as a change to the safe mode: event StatusChanged
#
# Add Law.fpp, Law.cpp and the law's source file to SOURCE_FILES of the component's CMakeLists.txt, and
# compile with -ffp-contract=off.
module FlightLaw {

  constant NQ = 12 # TO DO 1
  constant NV = 11 # TO DO 1

  array Positions = [NQ] F64
  array Velocities = [NV] F64

  @ Measured configuration and velocity
  port Measurement(ref q: Positions, ref v: Velocities)

  @ Desired configuration, velocity and its time derivative
  port Reference(ref q: Positions, ref v: Velocities, ref a: Velocities)

  @ Generalized force, N m and N
  port Force(ref values: Velocities)

  @ Whether the gripper holds the target
  port Target(holds: bool)

  @ The control law
  passive component Law {

    @ Rate group: one control sample
    guarded input port schedIn: Svc.Sched

    guarded input port measurementIn: Measurement

    guarded input port referenceIn: Reference

    @ The force that the actuators applied over the last period
    guarded input port appliedIn: Force

    guarded input port targetIn: Target

    output port forceOut: Force

    @ law_status of the last sample
    telemetry Status: U32 id 0 update on change

    @ Bits LAW_BAD_... of the last sample
    telemetry Causes: U32 id 1 update on change

    @ The law's status changed
    event StatusChanged(status: U32, causes: U32, sample: U32) \
      severity warning high \
      id 0 \
      format "law status {}, causes {} at sample {}"

    time get port timeCaller

    telemetry port tlmOut

    event port eventOut

    text event port eventOutText

  }

}
