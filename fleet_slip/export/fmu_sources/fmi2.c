/* An exported estimator as an FMU for co-simulation, FMI 2.0: inputs and outputs in SI units.
 *
 * Types and functions are those of the standard (fmi-standard.org, 2.0.4). fmi_model.h defines the
 * names, scales and samples of the estimator. Value references are the inputs from 0, then the
 * parameters, the angle, and valid. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "fmi_model.h"

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

#define ANGLE_REFERENCE (SIGNALS + PARAMETERS)
#define VALID_REFERENCE (SIGNALS + PARAMETERS + 1)

typedef struct {
    model_state state;
    double inputs[SIGNALS];
    int32_t parameters[PARAMETERS + 1];
    double angle;
    bool valid;
} instance;

static void clear(instance *self)
{
    (void)memset(self, 0, sizeof *self);
    for (size_t i = 0U; i < PARAMETERS; i++) {
        self->parameters[i] = INT32_MIN;
    }
}

/* Starts a drive with the parameters; called at the end of the initialization. */
static void start(instance *self)
{
    start_drive(&self->state, self->parameters);
    self->angle = 0.0;
    self->valid = false;
}

/* Nearest count of a physical value, halves to even; INT16_MIN if it is missing. */
static int16_t count_of(double physical, double scale)
{
    const double count = nearbyint(physical / scale);
    const bool inside = (count >= -32767.0) && (count <= 32767.0); /* false for NaN */
    return inside ? (int16_t)count : INT16_MIN;
}

/* Advances by ticks with constant inputs; returns false if the step is not a number of ticks. */
static bool advance(instance *self, double step_s)
{
    const double ticks = step_s / TICK_S;
    const double rounded = floor(ticks + 0.5);
    if (!((rounded >= 1.0) && (rounded <= 1e9) && (fabs(ticks - rounded) < 1e-3))) {
        return false;
    }
    for (uint32_t i = 0U; i < (uint32_t)rounded; i++) {
        int16_t counts[SIGNALS];
        model_sample sample;
        int32_t angle;
        for (size_t at = 0U; at < SIGNALS; at++) {
            counts[at] = count_of(self->inputs[at], scales[at]);
        }
        fill_sample(&sample, counts);
        self->valid = model_step(&self->state, &sample, &angle);
        self->angle = (double)angle * ANGLE_SCALE;
    }
    return true;
}

static bool get_real(const instance *self, uint32_t reference, double *value)
{
    if (reference == ANGLE_REFERENCE) {
        *value = self->angle;
    } else if (reference < SIGNALS) {
        *value = self->inputs[reference];
    } else {
        return false;
    }
    return true;
}

static bool set_real(instance *self, uint32_t reference, double value)
{
    if (reference >= SIGNALS) {
        return false;
    }
    self->inputs[reference] = value;
    return true;
}

static bool is_parameter(uint32_t reference)
{
    return (reference >= SIGNALS) && (reference < (SIGNALS + PARAMETERS));
}

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef void *fmi2Component;
typedef const char *fmi2String;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean;
typedef struct {
    void (*logger)(void *, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(void *, fmi2Status);
    void *componentEnvironment;
} fmi2CallbackFunctions;

/* An instance, first, so that a pointer to it is one to this, and where its messages go. */
typedef struct {
    instance model;
    fmi2CallbackFunctions functions;
    char name[64];
} component;

#define REFERENCES fmi2Component c, const fmi2ValueReference references[], size_t count

static fmi2Status status(bool is_valid)
{
    return is_valid ? fmi2OK : fmi2Error;
}

EXPORTED const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORTED const char *fmi2GetVersion(void) { return "2.0"; }

EXPORTED fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count,
                                        const fmi2String categories[])
{
    (void)c; (void)on; (void)count; (void)categories;
    return fmi2OK;
}

EXPORTED fmi2Component fmi2Instantiate(fmi2String name, int kind, fmi2String token,
                                       fmi2String resources, const fmi2CallbackFunctions *functions,
                                       fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources; (void)visible; (void)logging;
    if ((kind != 1) || (token == NULL) || (strcmp(token, TOKEN) != 0)) {
        if ((functions != NULL) && (functions->logger != NULL)) {
            functions->logger(functions->componentEnvironment, name, fmi2Error, "error",
                              "use it for co-simulation, with the GUID of its model description");
        }
        return NULL;
    }
    component *self = malloc(sizeof *self);
    if (self != NULL) {
        (void)memset(self, 0, sizeof *self);
        clear(&self->model);
        start(&self->model);
        if (functions != NULL) { self->functions = *functions; }
        if (name != NULL) { (void)strncpy(self->name, name, sizeof self->name - 1U); }
    }
    return self;
}

EXPORTED void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORTED fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, double tolerance,
                                        double start_time, fmi2Boolean stops, double stop)
{
    (void)c; (void)defined; (void)tolerance; (void)start_time; (void)stops; (void)stop;
    return fmi2OK;
}

EXPORTED fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
EXPORTED fmi2Status fmi2ExitInitializationMode(fmi2Component c) { start(c); return fmi2OK; }
EXPORTED fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }

EXPORTED fmi2Status fmi2Reset(fmi2Component c)
{
    clear(c);
    start(c);
    return fmi2OK;
}

EXPORTED fmi2Status fmi2GetReal(REFERENCES, double values[])
{
    bool is_valid = true;
    for (size_t i = 0U; i < count; i++) { is_valid = get_real(c, references[i], &values[i]) && is_valid; }
    return status(is_valid);
}

EXPORTED fmi2Status fmi2SetReal(REFERENCES, const double values[])
{
    bool is_valid = true;
    for (size_t i = 0U; i < count; i++) { is_valid = set_real(c, references[i], values[i]) && is_valid; }
    return status(is_valid);
}

EXPORTED fmi2Status fmi2GetInteger(REFERENCES, int values[])
{
    const instance *self = c;
    for (size_t i = 0U; i < count; i++) {
        if (!is_parameter(references[i])) { return fmi2Error; }
        values[i] = self->parameters[references[i] - SIGNALS];
    }
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SetInteger(REFERENCES, const int values[])
{
    instance *self = c;
    for (size_t i = 0U; i < count; i++) {
        if (!is_parameter(references[i])) { return fmi2Error; }
        self->parameters[references[i] - SIGNALS] = values[i];
    }
    return fmi2OK;
}

EXPORTED fmi2Status fmi2GetBoolean(REFERENCES, fmi2Boolean values[])
{
    const instance *self = c;
    for (size_t i = 0U; i < count; i++) {
        if (references[i] != VALID_REFERENCE) { return fmi2Error; }
        values[i] = self->valid ? 1 : 0;
    }
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SetBoolean(REFERENCES, const fmi2Boolean values[])
{
    (void)c; (void)references; (void)values;
    return status(count == 0U);
}

EXPORTED fmi2Status fmi2GetString(REFERENCES, fmi2String values[])
{
    (void)c; (void)references; (void)values;
    return status(count == 0U);
}

EXPORTED fmi2Status fmi2SetString(REFERENCES, const fmi2String values[])
{
    (void)c; (void)references; (void)values;
    return status(count == 0U);
}

EXPORTED fmi2Status fmi2GetFMUstate(fmi2Component c, void **state)
{
    if (*state == NULL) { *state = malloc(sizeof(instance)); }
    if (*state == NULL) { return fmi2Error; }
    (void)memcpy(*state, c, sizeof(instance));
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SetFMUstate(fmi2Component c, void *state)
{
    (void)memcpy(c, state, sizeof(instance));
    return fmi2OK;
}

EXPORTED fmi2Status fmi2FreeFMUstate(fmi2Component c, void **state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, void *state, size_t *size)
{
    (void)c; (void)state;
    *size = sizeof(instance);
    return fmi2OK;
}

EXPORTED fmi2Status fmi2SerializeFMUstate(fmi2Component c, void *state, char bytes[], size_t size)
{
    (void)c;
    if (size != sizeof(instance)) { return fmi2Error; }
    (void)memcpy(bytes, state, size);
    return fmi2OK;
}

EXPORTED fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const char bytes[], size_t size,
                                            void **state)
{
    if (size != sizeof(instance)) { return fmi2Error; }
    const fmi2Status made = fmi2GetFMUstate(c, state);
    if (made == fmi2OK) { (void)memcpy(*state, bytes, size); }
    return made;
}

EXPORTED fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference of[],
                                                 size_t count, const fmi2ValueReference by[],
                                                 size_t more, const double by_values[],
                                                 double values[])
{
    (void)c; (void)of; (void)count; (void)by; (void)more; (void)by_values; (void)values;
    return fmi2Error;
}

EXPORTED fmi2Status fmi2SetRealInputDerivatives(REFERENCES, const int orders[],
                                                const double values[])
{
    (void)c; (void)references; (void)count; (void)orders; (void)values;
    return fmi2Error;
}

EXPORTED fmi2Status fmi2GetRealOutputDerivatives(REFERENCES, const int orders[], double values[])
{
    (void)c; (void)references; (void)count; (void)orders; (void)values;
    return fmi2Error;
}

EXPORTED fmi2Status fmi2DoStep(fmi2Component c, double time, double step, fmi2Boolean keeps)
{
    (void)time; (void)keeps;
    const component *self = c;
    if (advance(c, step)) { return fmi2OK; }
    if (self->functions.logger != NULL) {
        self->functions.logger(self->functions.componentEnvironment, self->name, fmi2Error, "error",
                               "the communication step of %g s is not a multiple of %g s", step,
                               (double)TICK_S);
    }
    return fmi2Error;
}

EXPORTED fmi2Status fmi2CancelStep(fmi2Component c) { (void)c; return fmi2Error; }

EXPORTED fmi2Status fmi2GetStatus(fmi2Component c, int kind, fmi2Status *value)
{
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetRealStatus(fmi2Component c, int kind, double *value)
{
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetIntegerStatus(fmi2Component c, int kind, int *value)
{
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetBooleanStatus(fmi2Component c, int kind, fmi2Boolean *value)
{
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}

EXPORTED fmi2Status fmi2GetStringStatus(fmi2Component c, int kind, fmi2String *value)
{
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}
