//% macro array(name, values, kind="int32_t")
    ${kind} ${name}[${values|length}] = {
//% for value in values
        ${value}${"," if not loop.last}
//% endfor
    };
//% endmacro
//% if changed
static void take_tick(${prefix}_gram *gram, const ${prefix}_gram_sample *sample, bool logged)
{
//% if "state->" in (lines + rows|sum(start=[]) + [course, yaw_rate])|join
    ${prefix}_gram *const state = gram;
//% endif
//% for line in lines
    ${line}
//% endfor
    if (logged) {
        if (!gram->started) {
            count_empty_row(gram);
        }
//% for one in sets
//% if not one.counted.times
${(array("row_%s"|format(loop.index0), rows[loop.index0])|indent(4, true)).rstrip()}
        count_row(gram, ${loop.index0}U, 0U, row_${loop.index0});
//% endif
//% endfor
    }
    gram->started = true;
    store_motion(gram, ${course}, ${yaw_rate});
//% for number, one in changed
//% set spec = "&changed[%s]"|format(loop.index0)
${array("row_%s"|format(number), rows[number], "const int32_t").rstrip()}
    gram->at_columns_${number} = store_columns(${spec}, gram->columns_${number}, gram->at_columns_${number}, row_${number});
    count_changes(gram, ${spec}, gram->columns_${number}, gram->at_columns_${number}, ${"gram->delay" if one.counted.in_time else "0"});
//% endfor
}

void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample)
{
    take_tick(gram, sample, true);
}

void ${prefix}_gram_pass(${prefix}_gram *gram)
{
    const ${prefix}_gram_sample empty = {${(["MISSING"] * program.signals|length)|join(", ")}};
    take_tick(gram, &empty, false);
}

//% else
void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample)
{
//% for line in lines
    ${line}
//% endfor
${array("row", rows[0]).rstrip()}
    count_row(gram, 0U, 0U, row);
}

//% endif
