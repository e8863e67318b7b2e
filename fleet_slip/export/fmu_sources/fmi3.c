/* An exported estimator as an FMU for co-simulation, FMI 3.0.
 *
 * Types and functions as the standard defines them (fmi-standard.org, 3.0.2). What an estimator
 * has not, such as clocks, continuous states and derivatives, answers with an error. */
#include "fmi_instance.h"

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef void *fmi3Instance;
typedef const char *fmi3String;
typedef uint32_t fmi3ValueReference;
typedef void (*fmi3Log)(void *, fmi3Status, fmi3String, fmi3String);

#define REFERENCES fmi3Instance one, const fmi3ValueReference references[], size_t many
#define UNUSED_REFERENCES (void)one; (void)references; (void)many

static fmi3Status told(bool good)
{
    return good ? fmi3OK : fmi3Error;
}

EXPORTED const char *fmi3GetVersion(void) { return "3.0"; }

EXPORTED fmi3Status fmi3SetDebugLogging(fmi3Instance one, bool on, size_t many,
                                        const fmi3String categories[])
{
    (void)one; (void)on; (void)many; (void)categories;
    return fmi3OK;
}

EXPORTED fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token,
                                                   fmi3String resources, bool visible, bool logging,
                                                   void *environment, fmi3Log log)
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log;
    return NULL;
}

EXPORTED fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
                                                        fmi3String resources, bool visible,
                                                        bool logging, void *environment,
                                                        fmi3Log log, void (*update)(void *),
                                                        void (*lock)(void), void (*unlock)(void))
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log; (void)update; (void)lock; (void)unlock;
    return NULL;
}

EXPORTED fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, bool visible, bool logging,
    bool event_mode, bool early_return, const fmi3ValueReference intermediate[],
    size_t intermediates, void *environment, fmi3Log log,
    void (*update)(void *, double, bool, bool, bool, bool, bool *, double *))
{
    (void)name; (void)resources; (void)visible; (void)logging; (void)event_mode;
    (void)early_return; (void)intermediate; (void)intermediates; (void)update;
    if ((token == NULL) || (strcmp(token, TOKEN) != 0)) {
        if (log != NULL) {
            log(environment, fmi3Error, "error", "its token must be that of its files");
        }
        return NULL;
    }
    instance *made = malloc(sizeof *made);
    if (made != NULL) {
        clear(made);
        begin(made);
    }
    return made;
}

EXPORTED void fmi3FreeInstance(fmi3Instance one) { free(one); }

EXPORTED fmi3Status fmi3EnterInitializationMode(fmi3Instance one, bool defined, double tolerance,
                                                double start, bool stops, double stop)
{
    (void)defined; (void)tolerance; (void)stops; (void)stop;
    ((instance *)one)->time = start;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3ExitInitializationMode(fmi3Instance one) { begin(one); return fmi3OK; }
EXPORTED fmi3Status fmi3EnterEventMode(fmi3Instance one) { (void)one; return fmi3OK; }
EXPORTED fmi3Status fmi3EnterStepMode(fmi3Instance one) { (void)one; return fmi3OK; }
EXPORTED fmi3Status fmi3Terminate(fmi3Instance one) { (void)one; return fmi3OK; }

EXPORTED fmi3Status fmi3Reset(fmi3Instance one)
{
    clear(one);
    begin(one);
    return fmi3OK;
}

EXPORTED fmi3Status fmi3GetFloat64(REFERENCES, double values[], size_t room)
{
    bool good = many == room;
    for (size_t i = 0U; good && (i < many); i++) { good = get_real(one, references[i], &values[i]); }
    return told(good);
}

EXPORTED fmi3Status fmi3SetFloat64(REFERENCES, const double values[], size_t room)
{
    bool good = many == room;
    for (size_t i = 0U; good && (i < many); i++) { good = set_real(one, references[i], values[i]); }
    return told(good);
}

EXPORTED fmi3Status fmi3GetInt32(REFERENCES, int32_t values[], size_t room)
{
    const instance *from = one;
    bool good = many == room;
    for (size_t i = 0U; good && (i < many); i++) {
        good = is_told(references[i]);
        if (good) { values[i] = from->told[references[i] - SIGNALS]; }
    }
    return told(good);
}

EXPORTED fmi3Status fmi3SetInt32(REFERENCES, const int32_t values[], size_t room)
{
    instance *to = one;
    bool good = many == room;
    for (size_t i = 0U; good && (i < many); i++) {
        good = is_told(references[i]);
        if (good) { to->told[references[i] - SIGNALS] = values[i]; }
    }
    return told(good);
}

EXPORTED fmi3Status fmi3GetBoolean(REFERENCES, bool values[], size_t room)
{
    const instance *from = one;
    bool good = many == room;
    for (size_t i = 0U; good && (i < many); i++) {
        good = references[i] == VALID_REFERENCE;
        if (good) { values[i] = from->valid; }
    }
    return told(good);
}

#define HAS_NONE_OF(NAME, TYPE)                                                                   \
    EXPORTED fmi3Status fmi3Get##NAME(REFERENCES, TYPE values[], size_t room)                     \
    {                                                                                             \
        (void)one; (void)references; (void)values; (void)room;                                    \
        return told(many == 0U);                                                                  \
    }                                                                                             \
    EXPORTED fmi3Status fmi3Set##NAME(REFERENCES, const TYPE values[], size_t room)               \
    {                                                                                             \
        (void)one; (void)references; (void)values; (void)room;                                    \
        return told(many == 0U);                                                                  \
    }

HAS_NONE_OF(Float32, float)
HAS_NONE_OF(Int8, int8_t)
HAS_NONE_OF(UInt8, uint8_t)
HAS_NONE_OF(Int16, int16_t)
HAS_NONE_OF(UInt16, uint16_t)
HAS_NONE_OF(UInt32, uint32_t)
HAS_NONE_OF(Int64, int64_t)
HAS_NONE_OF(UInt64, uint64_t)
HAS_NONE_OF(String, fmi3String)

EXPORTED fmi3Status fmi3SetBoolean(REFERENCES, const bool values[], size_t room)
{
    (void)one; (void)references; (void)values; (void)room;
    return told(many == 0U);
}

EXPORTED fmi3Status fmi3GetBinary(REFERENCES, size_t sizes[], const uint8_t *values[], size_t room)
{
    (void)one; (void)references; (void)sizes; (void)values; (void)room;
    return told(many == 0U);
}

EXPORTED fmi3Status fmi3SetBinary(REFERENCES, const size_t sizes[], const uint8_t *const values[],
                                  size_t room)
{
    (void)one; (void)references; (void)sizes; (void)values; (void)room;
    return told(many == 0U);
}

EXPORTED fmi3Status fmi3GetClock(REFERENCES, bool values[])
{
    (void)one; (void)references; (void)values;
    return told(many == 0U);
}

EXPORTED fmi3Status fmi3SetClock(REFERENCES, const bool values[])
{
    (void)one; (void)references; (void)values;
    return told(many == 0U);
}

EXPORTED fmi3Status fmi3GetFMUState(fmi3Instance one, void **state)
{
    if (*state == NULL) { *state = malloc(sizeof(instance)); }
    if (*state == NULL) { return fmi3Error; }
    (void)memcpy(*state, one, sizeof(instance));
    return fmi3OK;
}

EXPORTED fmi3Status fmi3SetFMUState(fmi3Instance one, void *state)
{
    (void)memcpy(one, state, sizeof(instance));
    return fmi3OK;
}

EXPORTED fmi3Status fmi3FreeFMUState(fmi3Instance one, void **state)
{
    (void)one;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3SerializedFMUStateSize(fmi3Instance one, void *state, size_t *size)
{
    (void)one; (void)state;
    *size = sizeof(instance);
    return fmi3OK;
}

EXPORTED fmi3Status fmi3SerializeFMUState(fmi3Instance one, void *state, uint8_t bytes[],
                                          size_t size)
{
    (void)one;
    if (size != sizeof(instance)) { return fmi3Error; }
    (void)memcpy(bytes, state, size);
    return fmi3OK;
}

EXPORTED fmi3Status fmi3DeserializeFMUState(fmi3Instance one, const uint8_t bytes[], size_t size,
                                            void **state)
{
    if (size != sizeof(instance)) { return fmi3Error; }
    const fmi3Status made = fmi3GetFMUState(one, state);
    if (made == fmi3OK) { (void)memcpy(*state, bytes, size); }
    return made;
}

EXPORTED fmi3Status fmi3DoStep(fmi3Instance one, double time, double step, bool keeps,
                               bool *event_needed, bool *terminate, bool *early, double *last)
{
    (void)keeps;
    *event_needed = false;
    *terminate = false;
    *early = false;
    const bool good = advance(one, step);
    *last = good ? (time + step) : time;
    ((instance *)one)->time = *last;
    return told(good);
}

EXPORTED fmi3Status fmi3UpdateDiscreteStates(fmi3Instance one, bool *again, bool *terminate,
                                             bool *nominals, bool *values, bool *has_next,
                                             double *next)
{
    (void)one; (void)next;
    *again = false;
    *terminate = false;
    *nominals = false;
    *values = false;
    *has_next = false;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance one, fmi3ValueReference of,
                                                        size_t *many)
{
    (void)one; (void)of; (void)many;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetVariableDependencies(fmi3Instance one, fmi3ValueReference of,
                                                size_t elements[], fmi3ValueReference by[],
                                                size_t by_elements[], int kinds[], size_t many)
{
    (void)one; (void)of; (void)elements; (void)by; (void)by_elements; (void)kinds; (void)many;
    return fmi3Error;
}

#define HAS_NO_DERIVATIVE(NAME)                                                                   \
    EXPORTED fmi3Status NAME(fmi3Instance one, const fmi3ValueReference of[], size_t many,        \
                             const fmi3ValueReference by[], size_t more, const double seed[],     \
                             size_t seeds, double values[], size_t room)                          \
    {                                                                                             \
        (void)one; (void)of; (void)many; (void)by; (void)more; (void)seed; (void)seeds;           \
        (void)values; (void)room;                                                                 \
        return fmi3Error;                                                                         \
    }

HAS_NO_DERIVATIVE(fmi3GetDirectionalDerivative)
HAS_NO_DERIVATIVE(fmi3GetAdjointDerivative)

#define IS_NOT_A_MODE(NAME)                                                                       \
    EXPORTED fmi3Status NAME(fmi3Instance one) { (void)one; return fmi3Error; }

IS_NOT_A_MODE(fmi3EnterConfigurationMode)
IS_NOT_A_MODE(fmi3ExitConfigurationMode)
IS_NOT_A_MODE(fmi3EnterContinuousTimeMode)
IS_NOT_A_MODE(fmi3EvaluateDiscreteStates)

EXPORTED fmi3Status fmi3GetIntervalDecimal(REFERENCES, double intervals[], int qualifiers[])
{
    UNUSED_REFERENCES; (void)intervals; (void)qualifiers;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetIntervalFraction(REFERENCES, uint64_t counters[],
                                            uint64_t resolutions[], int qualifiers[])
{
    UNUSED_REFERENCES; (void)counters; (void)resolutions; (void)qualifiers;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetShiftDecimal(REFERENCES, double shifts[])
{
    UNUSED_REFERENCES; (void)shifts;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3GetShiftFraction(REFERENCES, uint64_t counters[], uint64_t resolutions[])
{
    UNUSED_REFERENCES; (void)counters; (void)resolutions;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetIntervalDecimal(REFERENCES, const double intervals[])
{
    UNUSED_REFERENCES; (void)intervals;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetIntervalFraction(REFERENCES, const uint64_t counters[],
                                            const uint64_t resolutions[])
{
    UNUSED_REFERENCES; (void)counters; (void)resolutions;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetShiftDecimal(REFERENCES, const double shifts[])
{
    UNUSED_REFERENCES; (void)shifts;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetShiftFraction(REFERENCES, const uint64_t counters[],
                                         const uint64_t resolutions[])
{
    UNUSED_REFERENCES; (void)counters; (void)resolutions;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3CompletedIntegratorStep(fmi3Instance one, bool keeps, bool *event,
                                                bool *terminate)
{
    (void)one; (void)keeps; (void)event; (void)terminate;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetTime(fmi3Instance one, double time)
{
    (void)one; (void)time;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3SetContinuousStates(fmi3Instance one, const double states[], size_t many)
{
    (void)one; (void)states;
    return told(many == 0U);
}

#define HAS_NO_STATE(NAME)                                                                        \
    EXPORTED fmi3Status NAME(fmi3Instance one, double values[], size_t many)                      \
    {                                                                                             \
        (void)one; (void)values;                                                                  \
        return told(many == 0U);                                                                  \
    }

HAS_NO_STATE(fmi3GetContinuousStateDerivatives)
HAS_NO_STATE(fmi3GetEventIndicators)
HAS_NO_STATE(fmi3GetContinuousStates)
HAS_NO_STATE(fmi3GetNominalsOfContinuousStates)

EXPORTED fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance one, size_t *many)
{
    (void)one;
    *many = 0U;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance one, size_t *many)
{
    (void)one;
    *many = 0U;
    return fmi3OK;
}

EXPORTED fmi3Status fmi3GetOutputDerivatives(REFERENCES, const int32_t orders[], double values[],
                                             size_t room)
{
    UNUSED_REFERENCES; (void)orders; (void)values; (void)room;
    return fmi3Error;
}

EXPORTED fmi3Status fmi3ActivateModelPartition(fmi3Instance one, fmi3ValueReference clock,
                                               double time)
{
    (void)one; (void)clock; (void)time;
    return fmi3Error;
}
