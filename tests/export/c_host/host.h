/* A very small importer for co-simulation: what the two versions of FMI have to offer to host.c. */
#ifndef HOST_H
#define HOST_H

#include <stddef.h>

/* Each function returns 1 if it worked; a run ends at the first that did not. */
typedef struct {
    int (*open)(const char *token);
    int (*set)(unsigned input, double value);
    int (*step)(double point, double size);
    int (*get)(const unsigned outputs[], size_t count, double values[]);
    int (*save)(char *bytes, size_t space, size_t *size);
    int (*load)(const char *bytes, size_t size);
    int (*close)(void);
} host_face;

extern const host_face host_fmi2, host_fmi3;

/* A function of the FMU, of the type that the FMI headers declare: looked up by its name in the loaded
   library, or, with HOST_LINKED (2 or 3, the version of FMI), one that the program is linked with. */
#if defined(HOST_LINKED)
#define HOST_FIND(name) (&name)
#else
typedef void host_function(void);
/* A function of the loaded library; ends the program if it is missing. */
host_function *host_find(const char *name);
#define HOST_FIND(name) ((name##TYPE *)host_find(#name))
#endif

#endif
