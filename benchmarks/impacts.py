"""A spinning target struck by two arms in turn, with admittance and without, and caged.

    python benchmarks/impacts.py

The figures of ``docs/impacts.md``.
"""

import numpy as np

from ffsm_drake.plugins.impacts.strikes import Cage, Strikes, run


def main() -> None:
    """Print the contacts of each run."""
    for name, mission in (
        ("admittance", Strikes(duration=6.0)),
        ("none", Strikes(admittance=None, duration=6.0)),
        ("admittance, then caged", Strikes(cage=Cage(), duration=14.0)),
    ):
        found = run(mission)
        print(f"{name}: largest contact force {found.force.max():.2f} N")
        for begin, end, spin in found.strikes:
            peak = found.force[(found.time >= begin) & (found.time <= end)].max()
            print(f"  {begin:.3f} to {end:.3f} s: {peak:.2f} N, then {spin:.3f} rad/s")
        drift = np.abs(found.momentum - found.momentum[0]).max(axis=0)
        speed = np.linalg.norm(found.v[-1, 9:11])
        print(f"  momentum to {drift[:2].max():.1e} N s and {drift[2]:.1e} N m s;", end=" ")
        torque = np.abs(found.torque).max()
        print(f"target at the end {speed:.4f} m/s; largest torque {torque:.1f} N m")
        if mission.cage is not None:
            last = found.time > mission.duration - 1.0
            held = found.force[last]
            print(
                f"  in the last second: {held.min():.2f} to {held.max():.2f} N on each tip;",
                end=" ",
            )
            spins = np.abs(found.spin[last]).max(), np.abs(found.v[last, 2]).max()
            print(f"target turns at {spins[0]:.4f} rad/s at most, base at {spins[1]:.4f}")


if __name__ == "__main__":
    main()
