#include "recording.h"

#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NUM_WHOLES 3
#define NUM_REALS (LAW_NUM_INPUTS + LAW_NV)
#define LONGEST_LINE (64 + 32 * NUM_REALS)

static void refuse(const char *path, size_t line, const char *why)
{
  (void)fprintf(stderr, "%s:%lu: %s\n", path, (unsigned long)line, why);
  exit(2);
}

/* A line: sample, is_first and holds as whole numbers, then inputs and commanded forces. */
static void read_line(char *text, const char *path, size_t line, recorded_sample *made)
{
  uint32_t wholes[NUM_WHOLES];
  double reals[NUM_REALS];
  law_real rounded[LAW_NUM_INPUTS];
  char *end;
  int i;
  for (i = 0; i < NUM_WHOLES; ++i) {
    unsigned long value;
    errno = 0;
    value = strtoul(text, &end, 10);
    if ((end == text) || (errno != 0) || (value > UINT32_MAX) || (*end != ' ')
        || (memchr(text, '-', (size_t)(end - text)) != NULL)) {
      refuse(path, line, "a line must begin with three whole numbers: sample is_first holds");
    }
    wholes[i] = (uint32_t)value;
    text = end;
  }
  for (i = 0; i < NUM_REALS; ++i) {
    reals[i] = strtod(text, &end);
    if ((end == text) || ((*end != ' ') && (*end != '\n') && (*end != '\0'))) {
      refuse(path, line, "too few numbers, or text that is no number; export this law again");
    }
    text = end;
  }
  while ((*text == ' ') || (*text == '\n')) {
    ++text;
  }
  if (*text != '\0') {
    refuse(path, line, "more numbers than this law has inputs and forces; export it again");
  }
  memset(made, 0, sizeof *made);
  for (i = 0; i < LAW_NUM_INPUTS; ++i) {
    rounded[i] = (law_real)reals[i];
  }
  memcpy(&made->in, rounded, sizeof rounded); /* law_in begins with its numbers */
  memcpy(made->inputs, reals, sizeof made->inputs);
  memcpy(made->commanded, &reals[LAW_NUM_INPUTS], sizeof made->commanded);
  made->in.sample = wholes[0];
  made->in.is_first = wholes[1];
  made->in.holds = wholes[2];
}

recorded_sample *read_recording(const char *path, size_t *count)
{
  static char text[LONGEST_LINE];
  recorded_sample *samples = NULL;
  size_t room = 0, line = 0, found = 0;
  FILE *file = fopen(path, "r");
  if (file == NULL) {
    refuse(path, 0, "cannot be opened; run this program in the folder of the kit");
  }
  while (fgets(text, (int)sizeof text, file) != NULL) {
    ++line;
    if ((strchr(text, '\n') == NULL) && !feof(file)) {
      refuse(path, line, "the line is too long; export this law again");
    }
    if (text[0] == '#') {
      continue;
    }
    if (found == room) {
      recorded_sample *more;
      room = (room == 0) ? 1024 : (2 * room);
      more = realloc(samples, room * sizeof *samples);
      if (more == NULL) {
        refuse(path, line, "not enough memory");
      }
      samples = more;
    }
    read_line(text, path, line, &samples[found]);
    ++found;
  }
  if (ferror(file) || (found == 0)) {
    refuse(path, line, "no samples; export this law again");
  }
  (void)fclose(file);
  *count = found;
  return samples;
}
