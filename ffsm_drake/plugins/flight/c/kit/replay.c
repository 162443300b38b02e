/* Replay of a recorded run: law_step computes the force of every sample, and this program compares
   it with the recorded one.

     replay [TOLERANCE [FILE [matrices]]]

   TOLERANCE  largest difference, as a share of the largest recorded force of its kind;
              0 compares bit for bit; default: as the file says
   FILE       default replay.txt
   matrices   also print the mass matrices at the first sample

   Exit codes: 0 all is equal; 1 a difference, or a sample with another status than LAW_OK;
   2 the arguments or the file are not usable. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "recording.h"

#define IS_SINGLE (sizeof(law_real) < sizeof(double))
#define NUM_KINDS 3
static const char *const KINDS[NUM_KINDS] = {
  "torque of the base, N m", "force of the base, N", "joints, N m or N"};

static int kind_of(int coordinate)
{
  return (coordinate < 3) ? 0 : ((coordinate < 6) ? 1 : 2);
}

/* Doubles between two, in units in the last place. */
static uint64_t units_between(double a, double b)
{
  uint64_t bits[2], at[2];
  const uint64_t sign = UINT64_C(1) << 63;
  int i;
  memcpy(&bits[0], &a, sizeof a);
  memcpy(&bits[1], &b, sizeof b);
  for (i = 0; i < 2; ++i) {
    at[i] = ((bits[i] & sign) != 0) ? (sign - (bits[i] & ~sign)) : (sign + bits[i]);
  }
  return (at[0] > at[1]) ? (at[0] - at[1]) : (at[1] - at[0]);
}

/* The law over all samples. */
static bool forces_are_equal(const recorded_sample *samples, size_t count, double tolerance)
{
  law_state state;
  double largest[NUM_KINDS] = {0.0}, difference[NUM_KINDS] = {0.0};
  size_t different = 0, bad = 0, first_bad = 0, k;
  uint64_t units = 0;
  bool equal;
  int i;
  law_start(&state);
  for (k = 0; k < count; ++k) {
    law_out out;
    if (law_step(&samples[k].in, &LAW_GAINS, &state, &out) != LAW_OK) {
      first_bad = (bad == 0) ? k : first_bad;
      ++bad;
    }
    for (i = 0; i < LAW_NV; ++i) {
      const double expected = samples[k].commanded[i], made = (double)out.commanded[i];
      const double by = fabs(made - expected);
      const int kind = kind_of(i);
      if (memcmp(&made, &expected, sizeof made) != 0) {
        const uint64_t apart = units_between(made, expected);
        ++different;
        units = (apart > units) ? apart : units;
      }
      if (!(by <= difference[kind])) { /* a NaN stays */
        difference[kind] = by;
      }
      largest[kind] = fmax(largest[kind], fabs(expected));
    }
  }
  printf("samples: %lu, not LAW_OK: %lu", (unsigned long)count, (unsigned long)bad);
  if (bad != 0) {
    printf(", the first is %lu", (unsigned long)first_bad);
  }
  printf("\nforces with other bits: %lu of %lu", (unsigned long)different,
         (unsigned long)(count * LAW_NV));
  if (!IS_SINGLE && (different != 0)) {
    printf(", by at most %llu units in the last place", (unsigned long long)units);
  }
  printf("\n");
  equal = (bad == 0) && ((tolerance > 0.0) || (different == 0));
  for (i = 0; i < NUM_KINDS; ++i) {
    const double share = (largest[i] > 0.0) ? (difference[i] / largest[i]) : difference[i];
    printf("%s: largest difference %.3g, largest force %.3g, ratio %.3g\n", KINDS[i],
           difference[i], largest[i], share);
    equal = equal && ((tolerance <= 0.0) || (share <= tolerance));
  }
  return equal;
}

/* The reference that law_reference computes, compared with the recorded one. */
static bool reference_is_equal(const recorded_sample *samples, size_t count)
{
#if LAW_HAS_REFERENCE
  const double tolerance = IS_SINGLE ? 1e-5 : 1e-9;
  const size_t first = offsetof(law_in, q_d) / sizeof(law_real);
  const size_t frame = first + LAW_NQ + 2U * LAW_NV + LAW_NV + (LAW_READS_IS_NEW * (LAW_NQ + LAW_NV));
  double largest = 0.0, largest_of_frame = 0.0;
  size_t k, i;
  for (k = 0; k < count; ++k) {
    law_in in = samples[k].in;
    law_real made[LAW_NUM_INPUTS];
    law_reference(in.sample, &in);
    memcpy(made, &in, sizeof made);
    for (i = first; i < first + LAW_NQ + 2U * LAW_NV; ++i) {
      /* in single precision, large numbers have large rounding errors */
      const double size = IS_SINGLE ? fmax(1.0, fabs(samples[k].inputs[i])) : 1.0;
      const double by = fabs((double)made[i] - samples[k].inputs[i]) / size;
      largest = (by <= largest) ? largest : by;
    }
    for (i = frame; i < frame + 19U * LAW_READS_FRAME; ++i) {
      const double size = IS_SINGLE ? fmax(1.0, fabs(samples[k].inputs[i])) : 1.0;
      const double by = fabs((double)made[i] - samples[k].inputs[i]) / size;
      largest_of_frame = (by <= largest_of_frame) ? largest_of_frame : by;
    }
  }
  printf("reference: largest difference of q_d, v_d and a_d %.3g", largest);
  if (LAW_READS_FRAME) {
    printf(", of desired_frame %.3g", largest_of_frame);
  }
  printf("\n");
  return (largest <= tolerance) && (largest_of_frame <= tolerance);
#else
  (void)samples;
  (void)count;
  printf("reference: the caller gives it\n");
  return true;
#endif
}

/* Whether a mass matrix is symmetric with a positive diagonal. */
static bool is_a_mass_matrix(law_real H[LAW_NV][LAW_NV])
{
  const double rounding = IS_SINGLE ? 1e-5 : 1e-12;
  bool is_one = true;
  int i, j;
  for (i = 0; i < LAW_NV; ++i) {
    is_one = is_one && (H[i][i] > (law_real)0) && isfinite(H[i][i]);
    for (j = 0; j < i; ++j) {
      const double size = sqrt((double)H[i][i] * (double)H[j][j]);
      is_one = is_one && (fabs((double)H[i][j] - (double)H[j][i]) <= rounding * size);
    }
  }
  return is_one;
}

static void print_matrix(const char *name, law_real H[LAW_NV][LAW_NV])
{
  int i, j;
  printf("%s at the first sample:\n", name);
  for (i = 0; i < LAW_NV; ++i) {
    for (j = 0; j < LAW_NV; ++j) {
      printf(" %.17g", (double)H[i][j]);
    }
    printf("\n");
  }
}

static bool mass_matrices_are_good(const recorded_sample *samples, size_t count, bool are_printed)
{
  law_real H[LAW_NV][LAW_NV];
  bool are = true;
  size_t k;
  for (k = 0; k < count; ++k) {
    law_mass_matrix(samples[k].in.q, H);
    are = are && is_a_mass_matrix(H);
    if (are_printed && (k == 0)) {
      print_matrix("law_mass_matrix", H);
    }
#if LAW_HAS_CAPTURE
    law_mass_matrix_without_target(samples[k].in.q, H);
    are = are && is_a_mass_matrix(H);
    if (are_printed && (k == 0)) {
      print_matrix("law_mass_matrix_without_target", H);
    }
#endif
  }
  return are;
}

int main(int argc, char **argv)
{
  const char *path = (argc > 2) ? argv[2] : "replay.txt";
  double tolerance = 0.0;
  char *end = NULL;
  recording run;
  bool forces, reference, matrices;
  if (argc > 1) {
    tolerance = strtod(argv[1], &end);
  }
  if ((argc > 4) || ((argc > 3) && (strcmp(argv[3], "matrices") != 0))
      || ((argc > 1) && ((*end != '\0') || !(tolerance >= 0.0)))) {
    (void)fprintf(stderr, "usage: replay [TOLERANCE [FILE [matrices]]], TOLERANCE from 0\n");
    return 2;
  }
  run = read_recording(path);
  tolerance = (argc > 1) ? tolerance : run.tolerance;
  matrices = mass_matrices_are_good(run.samples, run.count, argc > 3);
  forces = forces_are_equal(run.samples, run.count, tolerance);
  reference = reference_is_equal(run.samples, run.count);
  free(run.samples);
  if (!forces) {
    printf("FAILED: forces differ by more than the tolerance %g, or a status is not LAW_OK\n",
           tolerance);
  }
  if (!reference) {
    printf("FAILED: law_reference differs from the recorded reference\n");
  }
  if (!matrices) {
    printf("FAILED: a mass matrix is not symmetric with a positive diagonal\n");
  }
  if (forces && reference && matrices) {
    printf("passed: %s\n", (tolerance > 0.0) ? "within the tolerance" : "equal bit for bit");
    return 0;
  }
  return 1;
}
