"""A run with flight sensors whose gains and filter are the tests' own: the shipped ones may be
tuned without these.
"""

FLIGHT = (
    "flight_sensors",
    "controller=tdc",
    "controllers.tdc.k_d={base_position: 4, base_rotation: 10, joints: 20}",
    "controllers.tdc.k_p={base_position: 4, base_rotation: 25, joints: 100}",
    "estimator.kind=kalman",
    "estimator.walk={base_position: 1e-3, base_rotation: 1e-3, joints: 1e-2}",
    "estimator.position_noise={base_position: 1e-3, base_rotation: 5e-5, joints: 1e-5}",
    "estimator.velocity_noise={base_position: 1e-3, base_rotation: 1.5e-5, joints: 1e-4}",
    "actuation.limit=null",
)
NO_NOISE = ("sensing.position_noise=0", "sensing.velocity_noise=0")
