// Skeleton of a component of F Prime around the law. Law.fpp lists what you fill in.
#include "Law.hpp"

namespace FlightLaw {

namespace {

template <typename From>
void copy(const From& from, law_real* to) {
  for (U32 i = 0; i < From::SIZE; ++i) {
    to[i] = static_cast<law_real>(from[i]);
  }
}

}  // namespace

Law::Law(const char* name) : LawComponentBase(name), m_in(), m_state(), m_status(LAW_OK) {
  law_start(&m_state);
  m_in.is_first = 1;
#if LAW_READS_IS_NEW
  for (law_real& each : m_in.is_new) {
    each = 1;  // TO DO 3: 0 where a measurement is repeated
  }
#endif
}

// One control sample. A missing measurement is all zero, so that its quaternion is refused.
void Law::schedIn_handler(FwIndexType, U32) {
  law_out out;
#if LAW_HAS_REFERENCE
  law_reference(m_in.sample, &m_in);
#endif
  const law_status status = law_step(&m_in, &LAW_GAINS, &m_state, &out);
  Velocities force;
  for (U32 i = 0; i < Velocities::SIZE; ++i) {
    force[i] = static_cast<F64>(out.force[i]);
  }
  forceOut_out(0, force);
  tlmWrite_Status(out.status);
  tlmWrite_Causes(out.causes);
  if (status != m_status) {  // TO DO 6
    log_WARNING_HI_StatusChanged(out.status, out.causes, m_in.sample);
  }
  m_status = status;
  for (law_real& each : m_in.q) {
    each = 0;  // a measurement that does not come again is bad
  }
  m_in.is_first = 0;
  ++m_in.sample;
}

void Law::measurementIn_handler(FwIndexType, Positions& q, Velocities& v) {
  copy(q, m_in.q);
  copy(v, m_in.v);
}

void Law::referenceIn_handler(FwIndexType, Positions& q, Velocities& v, Velocities& a) {
  copy(q, m_in.q_d);
  copy(v, m_in.v_d);
  copy(a, m_in.a_d);
}

void Law::appliedIn_handler(FwIndexType, Velocities& values) {
  copy(values, m_in.applied_force);
}

void Law::targetIn_handler(FwIndexType, bool holds) { m_in.holds = holds ? 1 : 0; }

}  // namespace FlightLaw
