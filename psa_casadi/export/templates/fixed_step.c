/* {{ name }}.h tells what this is */
#include "{{ name }}.h"

#include <math.h>

{% if plan.precision.single and s.states %}
/* x + change; what rounding takes is kept in low and added the next time */
static void gain({{ real }} *x, {{ real }} *low, {{ real }} change, {{ real }} nothing) {
    const {{ real }} sum = change + *low, next = *x + sum;
    *low = (sum - (next - *x) + nothing) - nothing;
    *x = (next + nothing) - nothing;
}

{% endif %}
void {{ name }}_init({{ name }}_state *state) {
{% for field, value in start %}
    state->{{ field }} = {{ value }};
{% endfor %}
}

{% if advance %}
/* One step, from last_input along its change */
static void advance({{ name }}_state *state{{ "" if plan.held else ", const " ~ name ~ "_input *change" }}) {
{% if not (plan.held or advance.uses("change->")) %}
    (void)change;
{% endif %}
{% for line in advance.lines %}
    {{ line }}
{% endfor %}
{% for text in advance.texts %}
    const {{ real }} end{{ loop.index0 }} = {{ text }};
{% endfor %}
{% for q in s.states %}
{% if plan.precision.single %}
    gain(&state->{{ q.name }}, &state->low_of_{{ q.name }}, end{{ loop.index0 }}, {{ nothing[loop.index0] }});
{% else %}
    state->{{ q.name }} = (state->{{ q.name }} + end{{ loop.index0 }} + {{ nothing[loop.index0] }}) - {{ nothing[loop.index0] }};
{% endif %}
{% endfor %}
{% for q in plan.expression.port_names %}
    state->port_of_{{ q }} = end{{ s.states | length + loop.index0 }};
{% endfor %}
{% if timed %}
    state->steps_done += {{ literal(1.0) }};
{% endif %}
}

{% endif %}
{% if sample %}
/* A sample instant */
static void sample({{ name }}_state *state) {
{% for line in sample.lines %}
    {{ line }}
{% endfor %}
{% for text in sample.texts %}
    const {{ real }} next{{ loop.index0 }} = {{ text }};
{% endfor %}
{% for q in s.sampled %}
    state->{{ q.name }} = next{{ loop.index0 }};
{% endfor %}
}

{% endif %}
static void outputs(const {{ name }}_state *state, {{ name }}_output *output) {
{% if not outputs.reads %}
    (void)state;
{% endif %}
{% if not s.outputs %}
    (void)output;
{% endif %}
{% for line in outputs.lines %}
    {{ line }}
{% endfor %}
{% for q in s.outputs %}
    output->{{ q.name }} = {{ outputs.texts[loop.index0] }};
{% endfor %}
}

int {{ name }}_step({{ name }}_state *state, const {{ name }}_input *{{ "wanted" if bounded else "input" }}, {{ name }}_output *output) {
{% if bounded %}
    {{ name }}_input within = *wanted;
    const {{ name }}_input *const input = &within;
    const {{ real }} v = wanted->voltage;
    const int beyond = !(v >= -{{ limit }} && v <= {{ limit }});
    within.voltage = v > {{ limit }} ? {{ limit }} : v < -{{ limit }} ? -{{ limit }}
                     : beyond ? state->last_input.voltage : v; /* if it is no number */
{% endif %}
{% set repeat = "for (int k = 0; k < %d; ++k) " | format(plan.substeps) if plan.substeps > 1 else "" %}
{% if not advance %}
    {{ "state->last_input = *input;" if s.inputs else "(void)input;" }}
{% elif not s.inputs %}
    (void)input;
    {{ repeat }}{{ "advance(state);" if plan.held else "advance(state, input);" }}
{% elif plan.held %}
    state->last_input = *input;
    {{ repeat }}advance(state);
{% else %}
    {{ name }}_input change;
{% for q in s.inputs %}
{% set difference = "input->" ~ q.name ~ " - state->last_input." ~ q.name %}
    change.{{ q.name }} = {{ "(%s) * %s" | format(difference, literal(1.0 / plan.substeps)) if repeat else difference }};
{% endfor %}
{% if repeat %}
    {{ repeat }}{
        advance(state, &change);
{% for q in s.inputs %}
        state->last_input.{{ q.name }} += change.{{ q.name }};
{% endfor %}
    }
{% else %}
    advance(state, &change);
{% endif %}
    state->last_input = *input;
{% endif %}
{% if plan.every == 1 %}
    sample(state);
{% elif plan.every %}
    if (--state->steps_to_instant == 0) {
        sample(state);
        state->steps_to_instant = {{ plan.every }};
    }
{% endif %}
    outputs(state, output);
    return {{ "beyond" if bounded else "0" }};
}
