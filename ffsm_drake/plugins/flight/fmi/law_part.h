/* The part of the FMU that steps: the control law of law.h. */
#include "law.h"

#include <stdbool.h>
#include <string.h>

/* Places of values; place 0 is the time. */
enum {
  AT_INPUTS = 1,
  AT_GAINS = AT_INPUTS + LAW_NUM_INPUTS,
  AT_OWN_REFERENCE = AT_GAINS + FMU_NUM_GAINS, /* 1: the law's own reference, not that of the inputs */
  AT_IS_FIRST,
  AT_HOLDS,
  AT_FORCE,
  AT_STATUS = AT_FORCE + LAW_NV,
  AT_CAUSES,
  AT_WARNINGS,
  PART_NUM_VALUES
};

typedef struct {
  law_state state;
} part_memory;

static bool part_begin(part_memory *memory, double *values)
{
  (void)values;
  law_start(&memory->state);
  return true;
}

/* The force of the sample at which a step begins. */
static bool part_step(part_memory *memory, double *values, uint64_t sample)
{
  law_real inputs[LAW_NUM_INPUTS], numbers[FMU_NUM_GAINS + 1];
  law_in in;
  law_gains gains = LAW_GAINS;
  law_out out;
  for (int i = 0; i < LAW_NUM_INPUTS; ++i) {
    inputs[i] = (law_real)values[AT_INPUTS + i];
  }
  for (int i = 0; i < FMU_NUM_GAINS; ++i) {
    numbers[i] = (law_real)values[AT_GAINS + i];
  }
  (void)memset(&in, 0, sizeof in);
  (void)memcpy(&in, inputs, sizeof inputs);
  (void)memcpy(&gains, numbers, FMU_NUM_GAINS * sizeof(law_real));
  in.sample = (sample < UINT32_MAX) ? (uint32_t)sample : UINT32_MAX;
#if LAW_HAS_REFERENCE
  if (values[AT_OWN_REFERENCE] > 0.5) {
    law_reference(in.sample, &in);
  }
#endif
  in.is_first = (uint32_t)((sample == 0U) || (values[AT_IS_FIRST] > 0.5));
  in.holds = (uint32_t)(values[AT_HOLDS] > 0.5);
  (void)law_step(&in, &gains, &memory->state, &out);
  for (int i = 0; i < LAW_NV; ++i) {
    values[AT_FORCE + i] = (double)out.force[i];
  }
  values[AT_STATUS] = (double)out.status;
  values[AT_CAUSES] = (double)out.causes;
  values[AT_WARNINGS] = (double)out.warnings;
  return true;
}
