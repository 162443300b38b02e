/* Hostile inputs for law_step: NaN, infinities, denormals, huge numbers, wrong quaternions, wild
   whole numbers and gains, between good samples of a recorded run.

     fuzz [COUNT [SEED [FILE]]]

   COUNT  hostile samples, default 1000000
   SEED   of the random bytes, default 1
   FILE   recorded run with the good samples, default replay.txt

   With -DLIBFUZZER it is a target of libFuzzer, which makes the bytes; FILE is then replay.txt in
   the current folder. The first violated rule is printed, and the program aborts. The rules:

   1. The status is LAW_OK exactly if there are no causes, and all outputs are finite, forces at
      most LAW_LARGEST.
   2. A sample with a number that is not finite or beyond LAW_LARGEST, or without a unit
      quaternion, is not LAW_OK, and its causes name the input.
   3. A bad sample leaves the memory as it was, except good and bad. After a bad result without
      LAW_SETTLED good samples before it, the memory is that of law_start.
   4. Up to LAW_MOST_HELD bad samples hold the last good force; further ones give zero.
   5. After refused inputs, all good samples are LAW_OK. After inputs that were hostile but accepted,
      at most two good samples in a row are not, and none once the memory has begun anew.
   6. A mass matrix of a good sample is finite with a positive diagonal, and the reference of any
      sample is usable. */
#include <float.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "recording.h"

#define NUM_STATE (offsetof(law_state, has_started) / sizeof(law_real))
#define NUM_GAINS (sizeof(law_gains) / sizeof(law_real))
#define MANY (2U * (LAW_MOST_HELD + LAW_SETTLED)) /* good samples that end an episode */
#define LARGEST_REAL ((sizeof(law_real) == sizeof(double)) ? (law_real)DBL_MAX : (law_real)FLT_MAX)
#define SMALLEST_NORMAL ((sizeof(law_real) == sizeof(double)) ? (law_real)DBL_MIN : (law_real)FLT_MIN)

typedef struct {
  const uint8_t *data;
  size_t size, at;
} bytes;

typedef struct {
  law_state state;
  law_gains gains;
  uint32_t bad;        /* samples in a row that were not LAW_OK */
  law_real held[LAW_NV];
  bool is_strange; /* hostile inputs were accepted since the memory began */
  uint32_t failed; /* good samples in a row that were not LAW_OK */
  size_t next;     /* good sample of the recorded run */
} flight;

static recording run;
static const char *path = "replay.txt";
static unsigned long num_steps, num_hostile, num_by_status[3], num_restarts;

static void fail(const char *rule)
{
  (void)fflush(stdout);
  (void)fprintf(stderr, "FAILED: %s (hostile sample %lu, step %lu)\n", rule, num_hostile, num_steps);
  abort();
}

static void check(bool holds, const char *rule)
{
  if (!holds) {
    fail(rule);
  }
}

static uint8_t next_byte(bytes *source)
{
  uint8_t value = 0U;
  if (source->at < source->size) {
    value = source->data[source->at];
    ++source->at;
  }
  return value;
}

static uint32_t next_whole(bytes *source)
{
  uint32_t value = 0U;
  int i;
  for (i = 0; i < 4; ++i) {
    value = (value << 8) | next_byte(source);
  }
  return value;
}

static bool is_finite(law_real value)
{
  return (value <= LARGEST_REAL) && (value >= -LARGEST_REAL);
}

static bool are_good(const law_real *values, size_t size, law_real most)
{
  size_t i;
  for (i = 0; i < size; ++i) {
    if (!((values[i] <= most) && (values[i] >= -most))) {
      return false;
    }
  }
  return true;
}

/* A number that tests a limit. */
static law_real hostile_number(bytes *source)
{
  static const law_real zero = 0;
  law_real value = zero;
  unsigned char raw[sizeof(law_real)];
  size_t i;
  switch (next_byte(source) & 15U) {
    case 0: return zero / zero;
    case 1: return (law_real)1 / zero;
    case 2: return (law_real)-1 / zero;
    case 3: return -zero;
    case 4: return zero;
    case 5: return SMALLEST_NORMAL / (law_real)65536;
    case 6: return -SMALLEST_NORMAL / (law_real)3;
    case 7: return LARGEST_REAL;
    case 8: return -LARGEST_REAL;
    case 9: return LAW_LARGEST;
    case 10: return -LAW_LARGEST * (law_real)1.0001;
    case 11: return LAW_FASTEST;
    case 12: return SMALLEST_NORMAL;
    case 13: return (law_real)((double)next_whole(source) / 65536.0 - 32768.0);
    case 14: return (law_real)((double)next_whole(source) - 2147483648.0);
    default:
      for (i = 0; i < sizeof raw; ++i) {
        raw[i] = next_byte(source);
      }
      memcpy(&value, raw, sizeof value);
      return value;
  }
}

static bool have_same_bits(const void *a, const void *b, size_t size)
{
  return memcmp(a, b, size) == 0;
}

static double square_of(const law_real *quaternion)
{
  double square = 0.0;
  int i;
  for (i = 0; i < 4; ++i) {
    square += (double)quaternion[i] * (double)quaternion[i];
  }
  return square;
}

/* Causes that a sample must have at least. */
static uint32_t surely_bad(const law_in *in)
{
  uint32_t causes = 0U;
  law_real all[LAW_NUM_INPUTS];
  const size_t others = offsetof(law_in, applied_force) / sizeof(law_real) + LAW_NV;
  const law_real most = LAW_LARGEST;
  const double norm = 2.0 * (double)LAW_NORM;
  double square = square_of(in->q);
  memcpy(all, in, sizeof all);
  if (!(are_good(in->q, LAW_NQ, most) && are_good(in->v, LAW_NV, most) && (square <= 1.0 + norm)
        && (square >= 1.0 - norm))) {
    causes |= LAW_BAD_MEASUREMENT;
  }
  square = square_of(in->q_d);
  if (!(are_good(in->q_d, LAW_NQ, most) && are_good(in->v_d, LAW_NV, most)
        && are_good(in->a_d, LAW_NV, most) && (square <= 1.0 + norm) && (square >= 1.0 - norm))) {
    causes |= LAW_BAD_REFERENCE;
  }
  if (!are_good(in->applied_force, LAW_NV, most)) {
    causes |= LAW_BAD_FORCE;
  }
  if ((others < LAW_NUM_INPUTS) && !are_good(&all[others], LAW_NUM_INPUTS - others, most)) {
    causes |= LAW_BAD_OTHER;
  }
  return causes;
}

/* Rules 3 and 4. */
static void check_bad(flight *own, const law_state *before, const law_out *out)
{
  const law_real none[LAW_NV] = {0};
  law_state expected = *before;
  check((out->causes & ~31U) == 0U, "an unknown cause");
  if (own->bad < LAW_MOST_HELD) {
    check(out->status == (uint32_t)LAW_HOLDS, "rule 4: a bad sample that does not hold");
    check(have_same_bits(out->force, own->held, sizeof own->held), "rule 4: not the last force");
    expected.bad = before->bad + 1U;
  } else {
    check(out->status == (uint32_t)LAW_ZERO, "rule 4: too many bad samples, and not zero");
    check(have_same_bits(out->force, none, sizeof none), "rule 4: a force that is not zero");
  }
  if ((out->causes == LAW_BAD_RESULT) && (before->good < LAW_SETTLED)) {
    law_start(&expected);
    memcpy(expected.last_force, before->last_force, sizeof expected.last_force);
    expected.bad = (before->bad < LAW_MOST_HELD) ? (before->bad + 1U) : before->bad;
    ++num_restarts;
  }
  expected.good = 0U;
  check(have_same_bits(out->commanded, out->force, sizeof out->force), "rule 4: commanded");
  check(have_same_bits(&own->state, &expected, sizeof expected), "rule 3: the memory has changed");
  ++own->bad;
}

static law_status step(flight *own, const law_in *in)
{
  const law_state before = own->state;
  law_real memory[NUM_STATE], kept[NUM_STATE];
  const uint32_t bad = surely_bad(in);
  law_out out;
  law_status status;
  size_t i;
  memset(&out, 0xFF, sizeof out); /* numbers that are not written stay NaN */
  status = law_step(in, &own->gains, &own->state, &out);
  ++num_steps;
  check((status == LAW_OK) || (status == LAW_HOLDS) || (status == LAW_ZERO), "rule 1: status");
  check(out.status == (uint32_t)status, "rule 1: another status in law_out");
  check((out.causes == 0U) == (status == LAW_OK), "rule 1: causes and status");
  check((out.warnings & ~7U) == 0U, "rule 1: an unknown warning");
  check(are_good(out.force, LAW_NV, LAW_LARGEST), "rule 1: a force that is not usable");
  for (i = 0; i < LAW_NV; ++i) {
    check(is_finite(out.commanded[i]), "rule 1: a commanded force that is not finite");
  }
  check((out.causes & bad) == bad, "rule 2: an input that is not usable was accepted");
  ++num_by_status[status];
  if (status != LAW_OK) {
    check_bad(own, &before, &out);
    return status;
  }
  memcpy(memory, &own->state, sizeof memory);
  memcpy(kept, &before, sizeof kept);
  for (i = 0; i < NUM_STATE; ++i) { /* a gain without a bound may begin as infinite */
    check(is_finite(memory[i]) || (memory[i] == kept[i]), "rule 1: memory that is not finite");
  }
  check(own->state.bad == 0U, "the number of bad samples after a good one");
  check(own->state.good > 0U, "no good sample in a row after a good one");
  memcpy(own->held, out.force, sizeof own->held);
  own->bad = 0U;
  return status;
}

static const law_in *next_good(flight *own)
{
  const law_in *in = &run.samples[own->next].in;
  own->next = (own->next + 1U) % run.count;
  return in;
}

static void evaluate_mass_matrices(const law_in *in, bool is_good)
{
  law_real H[LAW_NV][LAW_NV];
  size_t i;
  law_mass_matrix(in->q, H);
#if LAW_HAS_CAPTURE
  if (in->holds == 0U) {
    law_mass_matrix_without_target(in->q, H);
  }
#endif
  for (i = 0; (i < LAW_NV) && is_good; ++i) {
    check(are_good(H[i], LAW_NV, LARGEST_REAL), "rule 6: a mass matrix that is not finite");
    check(H[i][i] > (law_real)0, "rule 6: a diagonal that is not positive");
  }
}

static void evaluate_reference(law_in *in, uint32_t sample)
{
#if LAW_HAS_REFERENCE
  law_reference(sample, in);
  check(in->sample == sample, "rule 6: the number of a sample");
  check((surely_bad(in) & LAW_BAD_REFERENCE) == 0U, "rule 6: a reference that is not usable");
#else
  in->sample = sample;
#endif
}

/* Rule 5. */
static void good_samples(flight *own, uint32_t count)
{
  uint32_t i;
  own->gains = LAW_GAINS;
  for (i = 0U; i < count; ++i) {
    const law_in *in = next_good(own);
    const bool was_strange = own->is_strange;
    const unsigned long restarts = num_restarts;
    const law_status status = step(own, in);
    evaluate_mass_matrices(in, true);
    own->is_strange = was_strange && (num_restarts == restarts);
    own->failed = (status == LAW_OK) ? 0U : (own->failed + 1U);
    check((status == LAW_OK) || was_strange, "rule 5: a good sample is bad");
    check(own->failed <= 2U, "rule 5: good samples stay bad");
  }
}

static void hostile_sample(flight *own, const law_in *in)
{
  ++num_hostile;
  evaluate_mass_matrices(in, false);
  own->failed = 0U;
  if (step(own, in) == LAW_OK) {
    own->is_strange = true;
  }
  own->gains = LAW_GAINS;
}

static void replace_numbers(law_in *in, bytes *source, size_t count)
{
  law_real all[LAW_NUM_INPUTS];
  size_t i;
  memcpy(all, in, sizeof all);
  for (i = 0; i < count; ++i) {
    const size_t place = next_byte(source) % LAW_NUM_INPUTS;
    all[place] = hostile_number(source);
  }
  memcpy(in, all, sizeof all);
}

static void replace_gains(flight *own, bytes *source, size_t count)
{
  law_real all[NUM_GAINS + 1U]; /* a law may have none */
  size_t i;
  memcpy(all, &own->gains, NUM_GAINS * sizeof all[0]);
  for (i = 0; (i < count) && (NUM_GAINS > 0U); ++i) {
    const size_t place = next_whole(source) % (NUM_GAINS + 1U);
    all[place] = hostile_number(source);
  }
  memcpy(&own->gains, all, NUM_GAINS * sizeof all[0]);
}

static void scale_quaternion(law_real *quaternion, bytes *source)
{
  static const double scales[8] = {0.0, 0.5, 0.93, 1.07, 1e-200, 3.0, 1e6, -1.0};
  const double scale = scales[next_byte(source) & 7U];
  int i;
  for (i = 0; i < 4; ++i) {
    quaternion[i] = (law_real)((double)quaternion[i] * scale);
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* A flight whose samples the bytes choose. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  bytes source = {NULL, 0U, 0U};
  flight own;
  uint32_t i;
  source.data = data;
  source.size = size;
  if (run.count == 0U) {
    run = read_recording(path);
  }
  memset(&own, 0, sizeof own);
  law_start(&own.state);
  own.gains = LAW_GAINS;
  own.next = next_whole(&source) % run.count;
  while (source.at < source.size) {
    law_in in = *next_good(&own);
    const uint8_t kind = next_byte(&source) & 15U;
    switch (kind) {
      case 0:
        own.next = next_whole(&source) % run.count;
        good_samples(&own, 1U);
        break;
      case 1:
        good_samples(&own, 1U + (next_byte(&source) & 3U));
        break;
      case 2: /* until it has surely recovered */
        good_samples(&own, MANY);
        break;
      case 3: /* another run in the same memory */
        memset(&own, 0, sizeof own);
        law_start(&own.state);
        own.gains = LAW_GAINS;
        own.next = next_whole(&source) % run.count;
        break;
      case 4:
      case 5:
      case 6:
        replace_numbers(&in, &source, 1U);
        hostile_sample(&own, &in);
        break;
      case 7:
        replace_numbers(&in, &source, 1U + (next_byte(&source) & 15U));
        hostile_sample(&own, &in);
        break;
      case 8:
        replace_numbers(&in, &source, 1U);
        for (i = 0U; i < LAW_MOST_HELD + 2U; ++i) {
          hostile_sample(&own, &in);
        }
        break;
      case 9:
        scale_quaternion(in.q, &source);
        hostile_sample(&own, &in);
        break;
      case 10:
        scale_quaternion(in.q_d, &source);
        hostile_sample(&own, &in);
        break;
      case 11: /* also from no rotation to a half turn */
        i = next_byte(&source) & 3U;
        in.q[i] = hostile_number(&source);
        in.q_d[i] = (law_real)(int8_t)next_byte(&source) / (law_real)127;
        hostile_sample(&own, &in);
        break;
      case 12:
        i = next_byte(&source) & 31U;
        evaluate_reference(&in, next_whole(&source) >> i);
        in.is_first = next_byte(&source);
        in.holds = next_byte(&source) & 3U;
        hostile_sample(&own, &in);
        break;
      case 13:
        replace_gains(&own, &source, 1U);
        hostile_sample(&own, &in);
        break;
      case 14:
        replace_gains(&own, &source, NUM_GAINS);
        hostile_sample(&own, &in);
        break;
      default: /* in range, but nothing that a spacecraft does */
        for (i = 0U; i < LAW_NV; ++i) {
          in.v[i] = (law_real)(int8_t)next_byte(&source) * LAW_FASTEST / (law_real)127;
          in.q[i + 1U] += (law_real)(int8_t)next_byte(&source) / (law_real)64;
          in.a_d[i] += (law_real)(int8_t)next_byte(&source);
        }
        hostile_sample(&own, &in);
        break;
    }
  }
  good_samples(&own, MANY);
  return 0;
}

#ifndef LIBFUZZER
static uint64_t next_random(uint64_t *state)
{
  *state ^= *state << 13;
  *state ^= *state >> 7;
  *state ^= *state << 17;
  return *state;
}

/* A whole number in an argument; false: there is none. */
static bool read_whole(const char *text, unsigned long *value)
{
  char *end;
  *value = strtoul(text, &end, 10);
  return (end != text) && (*end == '\0') && (text[0] != '-');
}

int main(int argc, char **argv)
{
  static uint8_t data[2048];
  unsigned long count = 1000000UL, seed = 1UL;
  uint64_t random;
  size_t i;
  if ((argc > 4) || ((argc > 1) && !read_whole(argv[1], &count))
      || ((argc > 2) && !read_whole(argv[2], &seed))) {
    (void)fprintf(stderr, "usage: fuzz [COUNT [SEED [FILE]]]; COUNT and SEED are whole numbers\n");
    return 2;
  }
  path = (argc > 3) ? argv[3] : path;
  random = UINT64_C(0x9E3779B97F4A7C15) ^ (uint64_t)seed;
  random = (random == 0U) ? 1U : random;
  while (num_hostile < count) {
    for (i = 0; i < sizeof data; ++i) {
      data[i] = (uint8_t)(next_random(&random) >> 56);
    }
    (void)LLVMFuzzerTestOneInput(data, sizeof data);
  }
  printf("steps: %lu, of them hostile: %lu\n", num_steps, num_hostile);
  printf("LAW_OK: %lu, LAW_HOLDS: %lu, LAW_ZERO: %lu, memory started anew: %lu\n",
         num_by_status[0], num_by_status[1], num_by_status[2], num_restarts);
  printf("passed\n");
  free(run.samples);
  return 0;
}
#endif
