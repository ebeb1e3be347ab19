#include "fmi_data.h"

#include <math.h>

const char psa_token[] = "{{ token }}";
const char psa_model_identifier[] = "{{ identifier }}";
const psa_variable psa_variables[PSA_VARIABLES] = {
{% for v, low, high in table %}
    {"{{ v.name }}", PSA_{{ v.kind | upper }}, {{ v.index }}, {{ low }}, {{ high }}},
{% endfor %}
};
{% for kind, name, size, items in arrays %}
const {{ kind }} psa_{{ name }}[PSA_{{ size }} + 1] = {{ "{%s}" | format(items | join(", ")) }};
{% endfor %}
const double psa_seen_duration = {{ duration }};
