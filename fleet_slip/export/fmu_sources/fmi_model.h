#include "${prefix}.h"

#define TOKEN "${token}"
#define SIGNALS ${program.signals|length}U
#define PARAMETERS ${parameters|length}U
#define TICK_S ${tick_s}
#define ANGLE_SCALE ${angle.scale|decimal}
#define model_step ${prefix}_step
typedef ${prefix}_state model_state;
typedef ${prefix}_sample model_sample;

static const double scales[SIGNALS] = { ${program.signals|map(attribute="scale")|map("decimal")|join(", ")} };

static void fill_sample(model_sample *to, const int16_t counts[])
{
//% for field in fields.signals
    to->${field} = counts[${loop.index0}];
//% endfor
}

static void start_drive(model_state *state, const int32_t parameters[])
{
//% if has_car
    ${prefix}_car car;
//% for field in fields.facts + fields.numbers
    car.${field} = parameters[${loop.index0}];
//% endfor
    ${prefix}_start(state, &car);
//% else
    (void)parameters;
    ${prefix}_start(state);
//% endif
}
