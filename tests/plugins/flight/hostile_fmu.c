/* Steps of an FMU with drawn bits as inputs, parameters and memory, for sanitizers. */
#include "fmi3.h"
#include "fmu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define STEPS 20000

fmi3Instance fmi3InstantiateCoSimulation(
  fmi3String, fmi3String, fmi3String, fmi3Boolean, fmi3Boolean, fmi3Boolean, fmi3Boolean,
  const fmi3ValueReference[], size_t, fmi3InstanceEnvironment, fmi3LogMessageCallback,
  fmi3IntermediateUpdateCallback);
void fmi3FreeInstance(fmi3Instance);
fmi3Status fmi3Reset(fmi3Instance);
fmi3Status fmi3EnterInitializationMode(fmi3Instance, fmi3Boolean, fmi3Float64, fmi3Float64,
                                       fmi3Boolean, fmi3Float64);
fmi3Status fmi3ExitInitializationMode(fmi3Instance);
fmi3Status fmi3DoStep(fmi3Instance, fmi3Float64, fmi3Float64, fmi3Boolean, fmi3Boolean *,
                      fmi3Boolean *, fmi3Boolean *, fmi3Float64 *);
fmi3Status fmi3SetFloat64(fmi3Instance, const fmi3ValueReference[], size_t, const fmi3Float64[],
                          size_t);
fmi3Status fmi3GetFloat64(fmi3Instance, const fmi3ValueReference[], size_t, fmi3Float64[], size_t);
fmi3Status fmi3GetFMUState(fmi3Instance, fmi3FMUState *);
fmi3Status fmi3SetFMUState(fmi3Instance, fmi3FMUState);
fmi3Status fmi3FreeFMUState(fmi3Instance, fmi3FMUState *);
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance, fmi3FMUState, size_t *);
fmi3Status fmi3SerializeFMUState(fmi3Instance, fmi3FMUState, fmi3Byte[], size_t);
fmi3Status fmi3DeserializeFMUState(fmi3Instance, const fmi3Byte[], size_t, fmi3FMUState *);

static uint64_t drawn = 88172645463325252U;

static uint64_t draw(void)
{
  drawn ^= drawn << 13U;
  drawn ^= drawn >> 7U;
  drawn ^= drawn << 17U;
  return drawn;
}

static double number(void)
{
  static const double odd[] = {0.0, -0.0, 1.0, 1e-310, 5e-324, 1e300, INFINITY, -INFINITY, NAN};
  const uint64_t kind = draw() % 4U, bits = draw();
  double found = 0.0;
  if (kind == 0U) {
    return odd[bits % (sizeof odd / sizeof odd[0])];
  }
  if (kind == 1U) {
    (void)memcpy(&found, &bits, sizeof found);
    return found;
  }
  return (double)(bits % 2000001U) * 1e-6 - 1.0;
}

static bool check(const char *what, bool holds)
{
  if (!holds) {
    (void)fprintf(stderr, "%s\n", what);
    exit(1);
  }
  return holds;
}

int main(void)
{
  fmi3Instance fmu = fmi3InstantiateCoSimulation("it", FMU_TOKEN, "", false, false, false, false,
                                                 NULL, 0U, NULL, NULL, NULL);
  fmi3FMUState state = NULL;
  size_t size = 0U;
  fmi3Byte *bytes = NULL;
  int done = 0, ended = 0;
  check("instance", fmu != NULL);
  check("state", fmi3GetFMUState(fmu, &state) == fmi3OK);
  check("size", fmi3SerializedFMUStateSize(fmu, state, &size) == fmi3OK);
  bytes = malloc(size);
  check("bytes", bytes != NULL);
  for (int i = 0; i < STEPS; ++i) {
    fmi3Boolean events = false, terminate = false, early = false;
    fmi3Float64 time = 0.0, last = 0.0, values[FMU_NUM_VALUES];
    if (i % 5 == 0) {
      check("reset", fmi3Reset(fmu) == fmi3OK);
      check("enter", fmi3EnterInitializationMode(fmu, false, 0.0, 0.0, false, 0.0) == fmi3OK);
      if (fmi3ExitInitializationMode(fmu) != fmi3OK) {
        continue;
      }
    }
    for (uint32_t k = 0U; k < FMU_NUM_VALUES; ++k) {
      const double value = number();
      if ((FMU_KINDS[k] == 'i') || ((FMU_KINDS[k] == 'p') && (i % 7 == 0))) {
        check("set", fmi3SetFloat64(fmu, &k, 1U, &value, 1U) == fmi3OK);
      }
    }
    if (i % 11 == 0) { /* memory of any bits, in the right mode */
      check("get", fmi3GetFMUState(fmu, &state) == fmi3OK);
      check("serialize", fmi3SerializeFMUState(fmu, state, bytes, size) == fmi3OK);
      const size_t first = sizeof FMU_TOKEN + FMU_NUM_VALUES * sizeof(double);
      for (size_t k = first; k < first + sizeof(part_memory); k += 1U + draw() % 64U) {
        bytes[k] = (fmi3Byte)draw();
      }
      check("deserialize", fmi3DeserializeFMUState(fmu, bytes, size, &state) == fmi3OK);
      check("put", fmi3SetFMUState(fmu, state) == fmi3OK);
    }
    const uint32_t zero = 0U;
    check("time", fmi3GetFloat64(fmu, &zero, 1U, &time, 1U) == fmi3OK);
    if (fmi3DoStep(fmu, time, FMU_SAMPLE_TIME, true, &events, &terminate, &early, &last)
        == fmi3OK) {
      done += 1;
    }
    ended += terminate;
    for (uint32_t k = 0U; k < FMU_NUM_VALUES; ++k) {
      if (FMU_KINDS[k] == 'o') {
        check("read", fmi3GetFloat64(fmu, &k, 1U, &values[k], 1U) == fmi3OK);
        check("finite", !IS_LAW || (i % 11 == 0) || ((values[k] - values[k]) == 0.0));
      }
    }
  }
  check("freed", fmi3FreeFMUState(fmu, &state) == fmi3OK);
  fmi3FreeInstance(fmu);
  free(bytes);
  (void)printf("%d steps, %d runs ended\n", done, ended);
  return 0;
}
