/* What both versions of FMI do with an exported estimator: take SI units, step, give SI units.
 *
 * fmi_model.h defines the estimator: its names, scales, and how a sample is filled. Value
 * references: the inputs from 0 on, what the car is told behind them, the angle, whether it is
 * valid, and the time. */
#ifndef FMI_INSTANCE_H
#define FMI_INSTANCE_H

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

#define ANGLE_REFERENCE (SIGNALS + TOLD)
#define VALID_REFERENCE (SIGNALS + TOLD + 1)
#define TIME_REFERENCE (SIGNALS + TOLD + 2)

typedef struct {
    model_state state;
    double inputs[SIGNALS];
    int32_t told[TOLD + 1];
    double angle;
    double time;
    bool valid;
} instance;

static void clear(instance *one)
{
    (void)memset(one, 0, sizeof *one);
    for (size_t i = 0U; i < TOLD; i++) {
        one->told[i] = INT32_MIN;
    }
}

/* Begins a drive: called when initialization ends, with what the car was told. */
static void begin(instance *one)
{
    begin_drive(&one->state, one->told);
    one->angle = 0.0;
    one->valid = false;
}

/* The count nearest to a physical value, halves to even; INT16_MIN where it is missing. */
static int16_t count_of(double physical, double scale)
{
    const double count = nearbyint(physical / scale);
    const bool inside = (count >= -32767.0) && (count <= 32767.0); /* not if it is not a number */
    return inside ? (int16_t)count : INT16_MIN;
}

/* Takes whole ticks with the inputs as they are; returns whether the step is of whole ticks. */
static bool advance(instance *one, double step_s)
{
    const double ticks = step_s / TICK_S;
    const double whole = floor(ticks + 0.5);
    if (!((whole >= 1.0) && (whole <= 1e9) && (fabs(ticks - whole) < 1e-3))) {
        return false;
    }
    for (uint32_t i = 0U; i < (uint32_t)whole; i++) {
        int16_t counts[SIGNALS];
        model_sample sample;
        int32_t angle;
        for (size_t at = 0U; at < SIGNALS; at++) {
            counts[at] = count_of(one->inputs[at], scales[at]);
        }
        fill_sample(&sample, counts);
        one->valid = model_step(&one->state, &sample, &angle);
        one->angle = (double)angle * ANGLE_SCALE;
    }
    return true;
}

static bool get_real(const instance *one, uint32_t reference, double *value)
{
    if (reference == ANGLE_REFERENCE) {
        *value = one->angle;
    } else if (reference == TIME_REFERENCE) {
        *value = one->time;
    } else if (reference < SIGNALS) {
        *value = one->inputs[reference];
    } else {
        return false;
    }
    return true;
}

static bool set_real(instance *one, uint32_t reference, double value)
{
    if (reference >= SIGNALS) {
        return false;
    }
    one->inputs[reference] = value;
    return true;
}

static bool is_told(uint32_t reference)
{
    return (reference >= SIGNALS) && (reference < (SIGNALS + TOLD));
}

#endif
