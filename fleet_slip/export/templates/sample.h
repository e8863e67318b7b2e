//% for one, field in zip(program.signals, fields.signals)
    ${kind} ${field}; /* ${one.scale|decimal} ${one.unit|unit}, ${one.min_count} to ${one.max_count} */
//% endfor
