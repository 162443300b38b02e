/* The part of the FMU that steps: the plant of plant.h, which is the loop without its law. */
#include "plant.h"

#include <stdbool.h>
#include <string.h>

/* Places of values; place 0 is the time. The outputs are in the order of plant_show. */
enum {
  AT_PAYLOAD = 1,
  AT_SEED,
  AT_FORCE,
  AT_OUTPUTS = AT_FORCE + PLANT_NV,
  PART_NUM_VALUES = AT_OUTPUTS + PLANT_NUM_OUTPUTS
};

#define WORDS 624U
#define FAR 397U
#define MOST_SEED 2147483647.0
#define BELOW_ONE 0.99999999999999988898 /* 1 - 2^-53 */

/* A Mersenne twister (mt19937), and the second number of a pair. */
typedef struct {
  uint32_t words[WORDS];
  uint32_t next;
  uint32_t has_second; /* 1 or 0 */
  double second;
} generator;

typedef struct {
  plant_cells cells;
  generator white, drifting; /* of the sensors' noise */
} part_memory;

static void seed(generator *of, uint32_t value)
{
  of->words[0] = value;
  for (uint32_t i = 1U; i < WORDS; ++i) {
    const uint32_t before = of->words[i - 1U];
    of->words[i] = 1812433253U * (before ^ (before >> 30U)) + i;
  }
  of->next = WORDS;
  of->has_second = 0U;
}

static uint32_t word(generator *of)
{
  uint32_t made = 0U;
  if (of->next >= WORDS) {
    for (uint32_t i = 0U; i < WORDS; ++i) {
      const uint32_t second = of->words[(i + 1U) % WORDS];
      const uint32_t both = (of->words[i] & 0x80000000U) | (second & 0x7FFFFFFFU);
      const uint32_t turned = (both >> 1U) ^ (((second & 1U) != 0U) ? 0x9908B0DFU : 0U);
      of->words[i] = of->words[(i + FAR) % WORDS] ^ turned;
    }
    of->next = 0U;
  }
  made = of->words[of->next];
  of->next += 1U;
  made ^= made >> 11U;
  made ^= (made << 7U) & 0x9D2C5680U;
  made ^= (made << 15U) & 0xEFC60000U;
  return made ^ (made >> 18U);
}

/* A number from -1 to 1. */
static double share(generator *of)
{
  const uint64_t low = word(of);
  const uint64_t high = word(of);
  const double made = (double)((high << 32U) | low) * (1.0 / 18446744073709551616.0);
  return 2.0 * ((made < 1.0) ? made : BELOW_ONE) - 1.0;
}

/* A normal number of deviation 1, by the polar method. */
static double normal(generator *of)
{
  double x = 0.0, y = 0.0, square = 0.0, factor = 0.0;
  if (of->has_second != 0U) {
    of->has_second = 0U;
    return of->second;
  }
  do {
    x = share(of);
    y = share(of);
    square = x * x + y * y;
  } while (!((square <= 1.0) && (square > 0.0)));
  factor = sqrt(log(square) * -2.0 / square);
  of->has_second = 1U;
  of->second = x * factor;
  return y * factor;
}

/* What a sample reads and senses; false if the run is lost. */
static bool sensed(part_memory *memory, double *values, uint32_t sample)
{
  plant_cells *cells = &memory->cells;
  plant_row(sample, cells);
#if PLANT_NUM_NOISE
  for (int i = 0; i < PLANT_NUM_NOISE; ++i) {
    cells->noise[i] = normal(&memory->white);
  }
#endif
#if PLANT_NUM_DRIFTS
  for (int i = 0; i < PLANT_NUM_DRIFTS; ++i) {
    cells->drift_noise[i] = normal(&memory->drifting);
  }
#endif
  instants(cells);
  plant_sense(cells);
  plant_show(cells, &values[AT_OUTPUTS]);
  return !(cells->lost[0] > 0.0);
}

static bool part_begin(part_memory *memory, double *values)
{
  plant_cells *cells = &memory->cells;
  generator seeds;
  if (!((values[AT_PAYLOAD] > 0.0) && (values[AT_PAYLOAD] <= 1e9))
      || !((values[AT_SEED] >= 0.0) && (values[AT_SEED] <= MOST_SEED))) {
    return false;
  }
  (void)memset(memory, 0, sizeof *memory);
  plant_start(values[AT_PAYLOAD], cells);
  /* sources draw once before their first sample */
  seed(&seeds, (uint32_t)values[AT_SEED]);
  seed(&memory->white, word(&seeds));
  for (int i = 0; i < PLANT_NUM_NOISE; ++i) {
    (void)normal(&memory->white);
  }
#if PLANT_NUM_DRIFTS
  for (int i = 0; i < PLANT_NUM_DRIFTS; ++i) {
    cells->drift[i] *= normal(&seeds);
  }
  seeds.has_second = 0U;
  seed(&memory->drifting, word(&seeds));
  for (int i = 0; i < PLANT_NUM_DRIFTS; ++i) {
    (void)normal(&memory->drifting);
  }
#endif
  (void)sensed(memory, values, 0U);
  return true;
}

/* The motion to the next sample under the force of the inputs; false if the run is lost. */
static bool part_step(part_memory *memory, double *values, uint64_t sample)
{
  plant_cells *cells = &memory->cells;
  (void)memcpy(cells->generalized_force, &values[AT_FORCE], sizeof cells->generalized_force);
  plant_act(cells);
  if (cells->lost[0] > 0.0) {
    return false;
  }
  plant_move(cells);
  return sensed(memory, values, (uint32_t)sample + 1U);
}
