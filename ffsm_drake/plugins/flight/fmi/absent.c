/* Functions of FMI 3.0 for what this FMU does not have: importers load them, and get an error. */
#include "fmi3.h"

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#define ABSENT(name) FMI3_FUNCTION(fmi3Status, name)
#define IS_ERROR \
  { \
    return fmi3Error; \
  }
#define VARIABLES \
  fmi3Instance instance, const fmi3ValueReference references[], size_t count
/* No variable has the type: only a call for none is right. */
#define OF_TYPE(type) \
  ABSENT(Get##type)(VARIABLES, fmi3##type values[], size_t size) \
  { \
    return ((count == 0U) && (size == 0U)) ? fmi3OK : fmi3Error; \
  } \
  ABSENT(Set##type)(VARIABLES, const fmi3##type values[], size_t size) \
  { \
    return ((count == 0U) && (size == 0U)) ? fmi3OK : fmi3Error; \
  }

OF_TYPE(Float32)
OF_TYPE(Int8)
OF_TYPE(UInt8)
OF_TYPE(Int16)
OF_TYPE(UInt16)
OF_TYPE(Int32)
OF_TYPE(UInt64)
OF_TYPE(String)

ABSENT(GetBinary)(VARIABLES, size_t sizes[], fmi3Binary values[], size_t size)
{
  return ((count == 0U) && (size == 0U)) ? fmi3OK : fmi3Error;
}

ABSENT(SetBinary)(VARIABLES, const size_t sizes[], const fmi3Binary values[], size_t size)
{
  return ((count == 0U) && (size == 0U)) ? fmi3OK : fmi3Error;
}

ABSENT(GetClock)(VARIABLES, fmi3Clock values[])
{
  return (count == 0U) ? fmi3OK : fmi3Error;
}

ABSENT(SetClock)(VARIABLES, const fmi3Clock values[])
{
  return (count == 0U) ? fmi3OK : fmi3Error;
}

/* Other kinds of FMU */
FMI3_FUNCTION(fmi3Instance, InstantiateModelExchange)(
  fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logs,
  fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
  return NULL;
}

FMI3_FUNCTION(fmi3Instance, InstantiateScheduledExecution)(
  fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logs,
  fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
  fmi3ClockUpdateCallback clock_update, fmi3LockPreemptionCallback lock,
  fmi3UnlockPreemptionCallback unlock)
{
  return NULL;
}

ABSENT(ActivateModelPartition)(fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 time)
IS_ERROR
ABSENT(EnterContinuousTimeMode)(fmi3Instance instance) IS_ERROR
ABSENT(CompletedIntegratorStep)(fmi3Instance instance, fmi3Boolean no_set_before,
                                fmi3Boolean *enter_event_mode, fmi3Boolean *terminate) IS_ERROR
ABSENT(SetTime)(fmi3Instance instance, fmi3Float64 time) IS_ERROR
ABSENT(SetContinuousStates)(fmi3Instance instance, const fmi3Float64 states[], size_t count)
IS_ERROR
ABSENT(GetContinuousStates)(fmi3Instance instance, fmi3Float64 states[], size_t count) IS_ERROR
ABSENT(GetContinuousStateDerivatives)(fmi3Instance instance, fmi3Float64 rates[], size_t count)
IS_ERROR
ABSENT(GetNominalsOfContinuousStates)(fmi3Instance instance, fmi3Float64 nominals[], size_t count)
IS_ERROR
ABSENT(GetEventIndicators)(fmi3Instance instance, fmi3Float64 indicators[], size_t count) IS_ERROR
ABSENT(GetNumberOfEventIndicators)(fmi3Instance instance, size_t *count) IS_ERROR
ABSENT(GetNumberOfContinuousStates)(fmi3Instance instance, size_t *count) IS_ERROR

/* Derivatives and dependencies */
ABSENT(GetOutputDerivatives)(VARIABLES, const fmi3Int32 orders[], fmi3Float64 values[],
                             size_t size) IS_ERROR
ABSENT(GetDirectionalDerivative)(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                 size_t num_unknowns, const fmi3ValueReference knowns[],
                                 size_t num_knowns, const fmi3Float64 seed[], size_t num_seed,
                                 fmi3Float64 sensitivity[], size_t size) IS_ERROR
ABSENT(GetAdjointDerivative)(fmi3Instance instance, const fmi3ValueReference unknowns[],
                             size_t num_unknowns, const fmi3ValueReference knowns[],
                             size_t num_knowns, const fmi3Float64 seed[], size_t num_seed,
                             fmi3Float64 sensitivity[], size_t size) IS_ERROR
ABSENT(GetNumberOfVariableDependencies)(fmi3Instance instance, fmi3ValueReference reference,
                                        size_t *count) IS_ERROR
ABSENT(GetVariableDependencies)(fmi3Instance instance, fmi3ValueReference dependent,
                                size_t elements[], fmi3ValueReference independents[],
                                size_t elements_of_independents[], fmi3DependencyKind kinds[],
                                size_t count) IS_ERROR

/* Configuration, events and clocks */
ABSENT(EnterConfigurationMode)(fmi3Instance instance) IS_ERROR
ABSENT(ExitConfigurationMode)(fmi3Instance instance) IS_ERROR
ABSENT(EnterEventMode)(fmi3Instance instance) IS_ERROR
ABSENT(EnterStepMode)(fmi3Instance instance) IS_ERROR
ABSENT(EvaluateDiscreteStates)(fmi3Instance instance) IS_ERROR
ABSENT(UpdateDiscreteStates)(fmi3Instance instance, fmi3Boolean *need_update,
                             fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
                             fmi3Boolean *values_changed, fmi3Boolean *next_time_defined,
                             fmi3Float64 *next_time) IS_ERROR
ABSENT(GetIntervalDecimal)(VARIABLES, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
IS_ERROR
ABSENT(GetIntervalFraction)(VARIABLES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                            fmi3IntervalQualifier qualifiers[]) IS_ERROR
ABSENT(GetShiftDecimal)(VARIABLES, fmi3Float64 shifts[]) IS_ERROR
ABSENT(GetShiftFraction)(VARIABLES, fmi3UInt64 counters[], fmi3UInt64 resolutions[]) IS_ERROR
ABSENT(SetIntervalDecimal)(VARIABLES, const fmi3Float64 intervals[]) IS_ERROR
ABSENT(SetIntervalFraction)(VARIABLES, const fmi3UInt64 counters[],
                            const fmi3UInt64 resolutions[]) IS_ERROR
ABSENT(SetShiftDecimal)(VARIABLES, const fmi3Float64 shifts[]) IS_ERROR
ABSENT(SetShiftFraction)(VARIABLES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
IS_ERROR
