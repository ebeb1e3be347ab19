#ifndef {{ guard }}
#define {{ guard }}
{% for name, value in defined.items() %}
#define {{ name }} {{ value }}
{% endfor %}
{% for name, values in arrays.items() %}
static const int {{ name }}[] __attribute__((unused)) = {{ "{%s}" | format((values + [0]) | join(", ")) }};
{% endfor %}
#endif
