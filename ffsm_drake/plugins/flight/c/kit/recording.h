/* The samples of a recorded run, from a text file. For host programs: it allocates memory. */
#ifndef KIT_RECORDING_H
#define KIT_RECORDING_H

#include <stddef.h>

#include "law.h"

typedef struct {
  law_in in;
  double inputs[LAW_NUM_INPUTS]; /* as recorded; those of in are rounded to law_real */
  double commanded[LAW_NV];      /* expected of law_step */
} recorded_sample;

typedef struct {
  recorded_sample *samples; /* free them */
  size_t count;
  double tolerance; /* of a replay, as a share of the largest force; 0: bit for bit */
} recording;

/* The samples of a file. If it is not usable, prints the reason and exits with the code 2. */
recording read_recording(const char *path);

#endif
