#include "{{ name }}.h"
#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
void psa_probe(long steps, const double *u, double *y);
void psa_probe(long steps, const double *u, double *y) {
    {{ name }}_state state;
    {{ name }}_input input;
    {{ name }}_output output;
    {{ name }}_init(&state);
    for (long k = 1; k < steps; ++k) {
{% for q in s.inputs %}
        input.{{ q.name }} = ({{ real }})u[k * {{ s.inputs | length }} + {{ loop.index0 }}];
{% endfor %}
        {{ name }}_step(&state, &input, &output);
{% for q in s.outputs %}
        *y++ = (double)output.{{ q.name }};
{% endfor %}
    }
}
