#include "${prefix}.h"

#define TOKEN "${token}"
#define SIGNALS ${signals}U
#define TOLD ${told}U
#define TICK_S ${tick}
#define ANGLE_SCALE ${scale}
#define model_step ${prefix}_step
typedef ${prefix}_state model_state;
typedef ${prefix}_sample model_sample;

static const double scales[SIGNALS] = { ${scales} };

static void fill_sample(model_sample *to, const int16_t counts[])
{
${fills}
}

static void begin_drive(model_state *state, const int32_t told[])
{
${begins}
}
