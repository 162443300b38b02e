// Stand-in for the code that F Prime generates of Law.fpp: types, and the base class of the component
// with its handlers and outputs. A test links it with a driver.
#ifndef STAND_IN_LAW_COMPONENT_HPP
#define STAND_IN_LAW_COMPONENT_HPP

#include <cstddef>
#include <cstdint>

using U32 = std::uint32_t;
using F64 = double;
using FwIndexType = std::int16_t;

namespace FlightLaw {

template <U32 N>
class Array {
 public:
  enum { SIZE = N };
  F64& operator[](U32 i) { return m_values[i]; }
  const F64& operator[](U32 i) const { return m_values[i]; }

 private:
  F64 m_values[N] = {};
};

using Positions = Array<12>;  // NQ and NV of Law.fpp
using Velocities = Array<11>;

class LawComponentBase {
 public:
  explicit LawComponentBase(const char*) {}
  virtual ~LawComponentBase() = default;

  virtual void schedIn_handler(FwIndexType, U32) = 0;
  virtual void measurementIn_handler(FwIndexType, Positions&, Velocities&) = 0;
  virtual void referenceIn_handler(FwIndexType, Positions&, Velocities&, Velocities&) = 0;
  virtual void appliedIn_handler(FwIndexType, Velocities&) = 0;
  virtual void targetIn_handler(FwIndexType, bool) = 0;

  Velocities sent;  // at forceOut
  U32 forces = 0, status = 0, causes = 0, changes = 0;

 protected:
  void forceOut_out(FwIndexType, Velocities& force) {
    sent = force;
    ++forces;
  }
  void tlmWrite_Status(U32 value) { status = value; }
  void tlmWrite_Causes(U32 value) { causes = value; }
  void log_WARNING_HI_StatusChanged(U32, U32, U32) { ++changes; }
};

}  // namespace FlightLaw

#endif
