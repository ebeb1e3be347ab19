
static void {{ function }}_part({{ arguments }}) {
    (void)t, (void)u, (void)change;
{% for line in lines %}
    {{ line }}
{% endfor %}
{% for text in texts %}
    const double end{{ loop.index0 }} = {{ text }};
{% endfor %}
{% for q in nothing %}
    x[{{ loop.index0 }}] = (x[{{ loop.index0 }}] + end{{ loop.index0 }} + {{ q }}) - {{ q }};
{% endfor %}
}

void {{ function }}({{ arguments }}) {
    double now[{{ [inputs, 1] | max }}] = {0.0}, part[{{ [inputs, 1] | max }}] = {0.0};
    for (int k = 0; k < {{ plan.substeps }}; ++k) {
        for (int i = 0; i < {{ inputs }}; ++i) {
            part[i] = change[i] * {{ 1.0 / plan.substeps }};
            now[i] = u[i] + k * part[i];
        }
        {{ function }}_part(t + k * {{ plan.step / plan.substeps }}, x, now, part);
    }
}
