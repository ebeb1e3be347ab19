/* Memory for one run after another (library.c). */
#ifndef PAGE_STDLIB_H
#define PAGE_STDLIB_H

#include <stddef.h>

/* What `free` is given stays taken up to the next `page_release`. */
void *malloc(size_t size);
void *calloc(size_t count, size_t size);
void free(void *memory);

/* How much is taken; and give back what was taken since. */
size_t page_mark(void);
void page_release(size_t mark);

#endif
