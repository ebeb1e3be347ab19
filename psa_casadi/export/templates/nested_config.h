#define NESTED_PARTS {{ parts | length }}
#define NESTED_WIRES {{ wires | length }}
#define NESTED_SHOWN {{ shown | length }}
#define NESTED_STARTS {{ starts | length }}
#define NESTED_TOKEN "{{ token }}"
#define NESTED_PLATFORM "{{ target.binaries(2) }}"
#define NESTED_SUFFIX "{{ target.suffix }}"
static const struct {
    const char *folder, *identifier, *token;
    int lines;
} NESTED[] = {
{%- for name, identifier, token, lines in parts %}{"{{ name }}", "{{ identifier }}", "{{ token }}", {{ lines | int }}}{{ ", " if not loop.last }}{% endfor %}};
static const struct {
    fmi2ValueReference output, input;
    int from, to;
} WIRES[] = {
{%- for output, input, from, to in wires %}{{ "{%su, %su, %s, %s}, " | format(output, input, from, to) }}{% endfor %}{0u, 0u, -1, -1}};
static const struct {
    fmi2ValueReference variable;
    int part;
} SHOWN[] = {
{%- for variable, part in shown %}{{ "{%su, %s}" | format(variable, part) }}{{ ", " if not loop.last }}{% endfor %}};
static const struct {
    fmi2ValueReference variable;
    int part;
    char kind;
    double value;
} STARTS[] = {
{%- for variable, part, kind, value in starts %}{{ "{%su, %s, '%s', %r}, " | format(variable, part, kind, value) }}{% endfor %}{0u, 0, 0, 0.0}};
