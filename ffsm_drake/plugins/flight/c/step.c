static uint32_t warnings_of(const law_in *in, const law_out *out)
{
  uint32_t warnings = 0U;
  (void)in;
  (void)out;
#if HAS_POSITION_LIMITS
  for (uint32_t i = 6U; i < LAW_NV; ++i) {
    if ((in->q[i + 1U] < LEAST_POSITION[i]) || (in->q[i + 1U] > MOST_POSITION[i])) {
      warnings |= LAW_BEYOND_POSITION;
    }
  }
#endif
#if HAS_RATE_LIMITS
  for (uint32_t i = 6U; i < LAW_NV; ++i) {
    if ((in->v[i] < LEAST_RATE[i]) || (in->v[i] > MOST_RATE[i])) {
      warnings |= LAW_BEYOND_RATE;
    }
  }
#endif
#if CHANGES_FORCE
  for (uint32_t i = 0U; i < LAW_NV; ++i) {
    if (fabs((double)(out->force[i] - out->commanded[i])) > 0.0) {
      warnings |= LAW_FORCE_LIMITED;
    }
  }
#endif
  return warnings;
}

/* The memory before the first sample; the last force stays. */
static void restart(law_state *state)
{
  const law_state before = *state;
  law_start(state);
  copy(state->last_force, before.last_force, LAW_NV);
  state->bad = before.bad;
}

law_status law_step(const law_in *in, const law_gains *gains, law_state *state, law_out *out)
{
  law_state before = *state, next = *state;
  law_out made;
  uint32_t causes = causes_in(in);
  (void)memset(&made, 0, sizeof made);
  if (causes == 0U) {
    bool is_first = (in->is_first != 0U) || (state->good == 0U);
#if LAW_HAS_CAPTURE
    if ((state->has_started != 0U) && ((in->holds != 0U) != (state->holds != 0U))) {
      is_first = true;
      if (in->holds != 0U) {
        resumed(in, gains, state, &before);
      } else {
        resumed_without_target(in, gains, state, &before);
      }
    }
    if (in->holds == 0U) {
      any_sample_without_target(is_first, in, gains, &before, &next, &made);
    } else {
      any_sample(is_first, in, gains, &before, &next, &made);
    }
#else
    any_sample(is_first, in, gains, &before, &next, &made);
#endif
    copy(next.last_force, made.force, LAW_NV);
    next.has_started = 1U;
    next.good += (next.good < LAW_SETTLED) ? 1U : 0U;
    next.holds = in->holds;
    next.bad = 0U;
    if (!is_usable(state, &next, &made)) {
      causes = LAW_BAD_RESULT;
    }
  }
  if (causes == 0U) {
    made.status = (uint32_t)LAW_OK;
    made.warnings = warnings_of(in, &made);
    *state = next;
  } else {
    if ((causes == LAW_BAD_RESULT) && (state->good < LAW_SETTLED)) {
      restart(state); /* what such as a huge integral makes of good inputs would stay bad */
    }
    state->good = 0U;
    if (state->bad < LAW_MOST_HELD) {
      state->bad += 1U;
      made.status = (uint32_t)LAW_HOLDS;
      copy(made.force, state->last_force, LAW_NV);
    } else {
      made.status = (uint32_t)LAW_ZERO;
      (void)memset(made.force, 0, sizeof made.force);
    }
    copy(made.commanded, made.force, LAW_NV);
    made.causes = causes;
  }
  *out = made;
  return (law_status)out->status;
}
