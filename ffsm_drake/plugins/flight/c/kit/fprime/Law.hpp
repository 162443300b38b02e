// Skeleton of a component of F Prime around the law. Law.fpp lists what you fill in.
#ifndef FLIGHT_LAW_HPP
#define FLIGHT_LAW_HPP

#include "LawComponentAc.hpp"

#include "law.h"

namespace FlightLaw {

static_assert(Positions::SIZE == LAW_NQ, "set NQ of Law.fpp to LAW_NQ");
static_assert(Velocities::SIZE == LAW_NV, "set NV of Law.fpp to LAW_NV");

class Law : public LawComponentBase {
 public:
  explicit Law(const char* name);

 private:
  void schedIn_handler(FwIndexType port, U32 context) override;
  void measurementIn_handler(FwIndexType port, Positions& q, Velocities& v) override;
  void referenceIn_handler(FwIndexType port, Positions& q, Velocities& v,
                           Velocities& a) override;
  void appliedIn_handler(FwIndexType port, Velocities& values) override;
  void targetIn_handler(FwIndexType port, bool holds) override;

  law_in m_in;
  law_state m_state;
  law_status m_status;
};

}  // namespace FlightLaw

#endif
