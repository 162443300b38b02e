/* An FMU for co-simulation with FMI 3.0. A step is one control sample.
 *
 * fmu.h has the variables, and names what steps (the part). The value reference of a variable is
 * its place in the array of values. All that changes is in one struct without pointers, so that a
 * state of the FMU is a copy of it.
 */
#include "fmi3.h"
#include "fmu.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TOKEN_SIZE (sizeof FMU_TOKEN)
#define LONGEST_MESSAGE 200U

typedef enum { INSTANTIATED, INITIALIZATION, STEPS, ENDED, TERMINATED } fmu_mode;

typedef struct {
  double values[FMU_NUM_VALUES];
  part_memory part;
  double start; /* s */
  uint64_t steps;
  fmu_mode mode;
} fmu_memory;

typedef struct {
  fmu_memory memory;
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
  bool logs;
} fmu_instance;

typedef char the_part_has_these_values[(PART_NUM_VALUES == FMU_NUM_VALUES) ? 1 : -1];

static fmi3Status refused(const fmu_instance *fmu, const char *message)
{
  if ((fmu != NULL) && fmu->logs && (fmu->log != NULL)) {
    fmu->log(fmu->environment, fmi3Error, "logStatusError", message);
  }
  return fmi3Error;
}

static void start(fmu_memory *memory)
{
  (void)memset(memory, 0, sizeof *memory);
  (void)memcpy(memory->values, FMU_STARTS, sizeof FMU_STARTS);
  memory->mode = INSTANTIATED;
}

static double time_of(const fmu_memory *memory)
{
  return memory->start + (double)memory->steps * FMU_SAMPLE_TIME;
}

static bool are_of_kinds(const fmu_instance *fmu, const fmi3ValueReference *references,
                         size_t count, size_t size, const void *values, const char *kinds)
{
  if ((fmu == NULL) || (count != size)) {
    return false;
  }
  if ((count > 0U) && ((references == NULL) || (values == NULL))) {
    return false;
  }
  for (size_t i = 0U; i < count; ++i) {
    if ((references[i] >= FMU_NUM_VALUES) || (strchr(kinds, FMU_KINDS[references[i]]) == NULL)) {
      return false;
    }
  }
  return true;
}

/* Kinds of variables that can be set now; those that are fixed only before the first step. */
static const char *settable(const fmu_instance *fmu, const char *kinds, const char *with_fixed)
{
  const bool is_before = (fmu != NULL) && (fmu->memory.mode <= INITIALIZATION);
  return is_before ? with_fixed : kinds;
}

#define VARIABLES fmi3Instance instance, const fmi3ValueReference references[], size_t count

/* Kinds: of those that can be read, of those that can be set, and of these with the fixed ones. */
#define OF_TYPE(name, type, readable, kinds, with_fixed) \
  FMI3_FUNCTION(fmi3Status, Get##name)(VARIABLES, type values[], size_t size) \
  { \
    const fmu_instance *fmu = instance; \
    if (!are_of_kinds(fmu, references, count, size, values, readable)) { \
      return refused(fmu, "not " #name " variables of this FMU, or not one value for each"); \
    } \
    for (size_t i = 0U; i < count; ++i) { \
      const fmu_memory *memory = &fmu->memory; \
      values[i] = FROM_NUMBER_##name( \
        (references[i] == 0U) ? time_of(memory) : memory->values[references[i]]); \
    } \
    return fmi3OK; \
  } \
  FMI3_FUNCTION(fmi3Status, Set##name)(VARIABLES, const type values[], size_t size) \
  { \
    fmu_instance *fmu = instance; \
    if (!are_of_kinds(fmu, references, count, size, values, \
                      settable(fmu, kinds, with_fixed))) { \
      return refused(fmu, "not " #name " variables that can be set now, or not one value for each"); \
    } \
    for (size_t i = 0U; i < count; ++i) { \
      if (!IS_EXACT_##name(values[i])) { \
        return refused(fmu, "a whole number must be at most 2^53"); \
      } \
    } \
    for (size_t i = 0U; i < count; ++i) { \
      fmu->memory.values[references[i]] = (double)values[i]; \
    } \
    return fmi3OK; \
  }

#define FROM_NUMBER_Float64(value) (value)
#define FROM_NUMBER_Boolean(value) ((value) > 0.5)
#define FROM_NUMBER_UInt32(value) ((fmi3UInt32)(value))
#define FROM_NUMBER_Int64(value) ((fmi3Int64)(value))
#define MOST_EXACT 9007199254740992 /* 2^53 */
#define IS_EXACT_Float64(value) true
#define IS_EXACT_Boolean(value) true
#define IS_EXACT_UInt32(value) true
#define IS_EXACT_Int64(value) (((value) <= MOST_EXACT) && ((value) >= -MOST_EXACT))

/* Kinds: t time; i, p, f, o real input, tunable and fixed parameter, output; b, c Boolean input
   and fixed parameter; u output of 32 bits; s fixed whole number. Others are hidden. */
OF_TYPE(Float64, fmi3Float64, "tipfo", "ip", "ipf")
OF_TYPE(Boolean, fmi3Boolean, "bc", "b", "bc")
OF_TYPE(UInt32, fmi3UInt32, "u", "", "")
OF_TYPE(Int64, fmi3Int64, "s", "", "s")

FMI3_FUNCTION(const char *, GetVersion)(void)
{
  return "3.0";
}

FMI3_FUNCTION(fmi3Status, SetDebugLogging)(fmi3Instance instance, fmi3Boolean logs,
                                           size_t num_categories, const fmi3String categories[])
{
  fmu_instance *fmu = instance;
  (void)num_categories;
  (void)categories;
  if (fmu == NULL) {
    return fmi3Error;
  }
  fmu->logs = logs;
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Instance, InstantiateCoSimulation)(
  fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logs,
  fmi3Boolean event_mode_used, fmi3Boolean early_return_allowed,
  const fmi3ValueReference intermediate_variables[], size_t num_intermediate_variables,
  fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
  fmi3IntermediateUpdateCallback intermediate_update)
{
  fmu_instance *fmu = NULL;
  (void)name;
  (void)resources;
  (void)visible;
  (void)event_mode_used;
  (void)early_return_allowed;
  (void)intermediate_variables;
  (void)num_intermediate_variables;
  (void)intermediate_update;
  if ((token == NULL) || (strcmp(token, FMU_TOKEN) != 0)) {
    if (logs && (log != NULL)) {
      log(environment, fmi3Error, "logStatusError", "the token is not this FMU's");
    }
    return NULL;
  }
  fmu = calloc(1U, sizeof *fmu);
  if (fmu != NULL) {
    fmu->environment = environment;
    fmu->log = log;
    fmu->logs = logs;
    start(&fmu->memory);
  }
  return fmu;
}

FMI3_FUNCTION(void, FreeInstance)(fmi3Instance instance)
{
  free(instance);
}

FMI3_FUNCTION(fmi3Status, EnterInitializationMode)(
  fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start_time,
  fmi3Boolean has_stop_time, fmi3Float64 stop_time)
{
  fmu_instance *fmu = instance;
  (void)has_tolerance;
  (void)tolerance;
  (void)has_stop_time;
  (void)stop_time;
  if ((fmu == NULL) || (fmu->memory.mode != INSTANTIATED)) {
    return refused(fmu, "only a new instance can be initialized; reset this one");
  }
  if (!(fabs(start_time) <= 1e9)) {
    return refused(fmu, "the start time must be a number of at most 1e9 s");
  }
  fmu->memory.start = start_time;
  fmu->memory.mode = INITIALIZATION;
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, ExitInitializationMode)(fmi3Instance instance)
{
  fmu_instance *fmu = instance;
  if ((fmu == NULL) || (fmu->memory.mode != INITIALIZATION)) {
    return refused(fmu, "the instance is not being initialized");
  }
  if (!part_begin(&fmu->memory.part, fmu->memory.values)) {
    return refused(fmu, "a parameter is not a number that it can have");
  }
  fmu->memory.mode = STEPS;
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, DoStep)(fmi3Instance instance, fmi3Float64 time, fmi3Float64 size,
                                  fmi3Boolean no_set_before, fmi3Boolean *needs_events,
                                  fmi3Boolean *terminate, fmi3Boolean *early_return,
                                  fmi3Float64 *last_time)
{
  fmu_instance *fmu = instance;
  fmu_memory *memory = NULL;
  char message[LONGEST_MESSAGE] = "";
  (void)no_set_before;
  if ((fmu == NULL) || (needs_events == NULL) || (terminate == NULL) || (early_return == NULL)
      || (last_time == NULL)) {
    return refused(fmu, "a step needs places for its results");
  }
  memory = &fmu->memory;
  *needs_events = false;
  *early_return = false;
  *terminate = memory->mode == ENDED;
  *last_time = time_of(memory);
  if ((memory->mode == ENDED) || (memory->steps >= FMU_MOST_STEPS)) {
    return refused(fmu, "the run has ended");
  }
  if (memory->mode != STEPS) {
    return refused(fmu, "initialize the instance before its first step");
  }
  if (!(fabs(size - FMU_SAMPLE_TIME) <= 1e-6 * FMU_SAMPLE_TIME)) { /* also for NaN */
    (void)snprintf(message, sizeof message, "a step must be one control sample, %g s, not %g",
                   FMU_SAMPLE_TIME, size);
    return refused(fmu, message);
  }
  if (!(fabs(time - time_of(memory)) <= 1e-3 * FMU_SAMPLE_TIME)) {
    (void)snprintf(message, sizeof message, "this step must begin at t = %.9g s, not %.9g",
                   time_of(memory), time);
    return refused(fmu, message);
  }
  if (!part_step(&memory->part, memory->values, memory->steps)) {
    memory->mode = ENDED;
    *terminate = true;
  }
  memory->steps += 1U;
  *last_time = time_of(memory);
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, Terminate)(fmi3Instance instance)
{
  fmu_instance *fmu = instance;
  if (fmu == NULL) {
    return fmi3Error;
  }
  fmu->memory.mode = TERMINATED;
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, Reset)(fmi3Instance instance)
{
  fmu_instance *fmu = instance;
  if (fmu == NULL) {
    return fmi3Error;
  }
  start(&fmu->memory);
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, GetFMUState)(fmi3Instance instance, fmi3FMUState *state)
{
  const fmu_instance *fmu = instance;
  if ((fmu == NULL) || (state == NULL)) {
    return refused(fmu, "no place for a state");
  }
  if (*state == NULL) {
    *state = malloc(sizeof(fmu_memory));
  }
  if (*state == NULL) {
    return refused(fmu, "no memory for a state");
  }
  (void)memcpy(*state, &fmu->memory, sizeof(fmu_memory));
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, SetFMUState)(fmi3Instance instance, fmi3FMUState state)
{
  fmu_instance *fmu = instance;
  if ((fmu == NULL) || (state == NULL)) {
    return refused(fmu, "no state");
  }
  (void)memcpy(&fmu->memory, state, sizeof(fmu_memory));
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, FreeFMUState)(fmi3Instance instance, fmi3FMUState *state)
{
  (void)instance;
  if (state != NULL) {
    free(*state);
    *state = NULL;
  }
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, SerializedFMUStateSize)(fmi3Instance instance, fmi3FMUState state,
                                                  size_t *size)
{
  if ((state == NULL) || (size == NULL)) {
    return refused(instance, "no state, or no place for its size");
  }
  *size = TOKEN_SIZE + sizeof(fmu_memory);
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, SerializeFMUState)(fmi3Instance instance, fmi3FMUState state,
                                             fmi3Byte bytes[], size_t size)
{
  if ((state == NULL) || (bytes == NULL) || (size != TOKEN_SIZE + sizeof(fmu_memory))) {
    return refused(instance, "no state, or not of its size");
  }
  (void)memcpy(bytes, FMU_TOKEN, TOKEN_SIZE);
  (void)memcpy(&bytes[TOKEN_SIZE], state, sizeof(fmu_memory));
  return fmi3OK;
}

FMI3_FUNCTION(fmi3Status, DeserializeFMUState)(fmi3Instance instance, const fmi3Byte bytes[],
                                               size_t size, fmi3FMUState *state)
{
  if ((state == NULL) || (bytes == NULL) || (size != TOKEN_SIZE + sizeof(fmu_memory))
      || (memcmp(bytes, FMU_TOKEN, TOKEN_SIZE) != 0)) {
    return refused(instance, "not a state of this FMU");
  }
  if (*state == NULL) {
    *state = malloc(sizeof(fmu_memory));
  }
  if (*state == NULL) {
    return refused(instance, "no memory for a state");
  }
  (void)memcpy(*state, &bytes[TOKEN_SIZE], sizeof(fmu_memory));
  return fmi3OK;
}
