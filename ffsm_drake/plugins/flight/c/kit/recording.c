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

/* A comment, which may set the tolerance. */
static void read_comment(const char *text, const char *path, size_t line, recording *made)
{
  static const char name[] = "# tolerance ";
  if (strncmp(text, name, sizeof name - 1) == 0) {
    char *end;
    made->tolerance = strtod(&text[sizeof name - 1], &end);
    if ((*end != '\n') || !(made->tolerance >= 0.0)) {
      refuse(path, line, "the tolerance must be a number from 0; export this law again");
    }
  }
}

recording read_recording(const char *path)
{
  static char text[LONGEST_LINE];
  recording made = {NULL, 0, 0.0};
  size_t room = 0, line = 0;
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
      read_comment(text, path, line, &made);
      continue;
    }
    if (made.count == room) {
      recorded_sample *more;
      room = (room == 0) ? 1024 : (2 * room);
      more = realloc(made.samples, room * sizeof *more);
      if (more == NULL) {
        refuse(path, line, "not enough memory");
      }
      made.samples = more;
    }
    read_line(text, path, line, &made.samples[made.count]);
    ++made.count;
  }
  if (ferror(file) || (made.count == 0)) {
    refuse(path, line, "no samples; export this law again");
  }
  (void)fclose(file);
  return made;
}
