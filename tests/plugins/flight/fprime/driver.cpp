// Gives the component of a kit the inputs of a recorded run, over the stand-in of F Prime, and
// compares the forces at forceOut. Then one measurement does not come.
#include "Law.hpp"

#include <cmath>
#include <cstdio>

extern "C" {
#include "recording.h"
}

using namespace FlightLaw;

namespace {

template <typename To>
To filled(const law_real* from) {
  To made;
  for (U32 i = 0; i < To::SIZE; ++i) {
    made[i] = from[i];
  }
  return made;
}

}  // namespace

int main() {
  const recording run = read_recording("replay.txt");
  Law law("law");
  LawComponentBase& port = law;
  double largest = 0, difference = 0;
  for (std::size_t k = 0; k < run.count; ++k) {
    const law_in& in = run.samples[k].in;
    Positions q = filled<Positions>(in.q);
    Velocities v = filled<Velocities>(in.v), applied = filled<Velocities>(in.applied_force);
    port.measurementIn_handler(0, q, v);
    port.appliedIn_handler(0, applied);
    port.schedIn_handler(0, 0);
    for (U32 i = 0; i < Velocities::SIZE; ++i) {
      const double wanted = run.samples[k].commanded[i];
      largest = std::fmax(largest, std::fabs(wanted));
      difference = std::fmax(difference, std::fabs(port.sent[i] - wanted));
    }
  }
  std::printf("%u forces, status %u, changes %u, ratio %.3g\n", port.forces, port.status,
              port.changes, difference / largest);
  const Velocities last = port.sent;
  port.schedIn_handler(0, 0);
  double held = 0;
  for (U32 i = 0; i < Velocities::SIZE; ++i) {
    held = std::fmax(held, std::fabs(port.sent[i] - last[i]));
  }
  std::printf("without a measurement: status %u, causes %u, changes %u, moved by %g\n", port.status,
              port.causes, port.changes, held);
  return 0;
}
