/* The law as the external controller of a simulation: the other end of the UDP loop of ffsm.

     fly [--host ADDRESS] [--port PORT]

   ADDRESS  IPv4 address to listen at, default 127.0.0.1
   PORT     default 5020; 0: any free one

     ffsm run SCENARIO -c ffsm_drake.plugins.udp.external:External

   It prints the address, answers requests until SIGINT or SIGTERM, and then prints the counts. A
   request that comes again gets the same reply, without another step of the law. Packets that are
   damaged, foreign or unsound are counted by reason and not answered; neither is a sample that is
   not LAW_OK. None of them changes the memory of the law.

   A packet is little-endian. Its head has 32 bytes: "FFSM", version (16 bits), flags (16 bits), run
   (64 bits), sample (64 bits), time (double, s). Doubles follow. Each run has its own memory.

   Exit codes: 0 after a signal; 2 the arguments or the address are not usable. */
#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "law.h"

#define HEAD 32U
#define VERSION 1U
#define IS_FIRST 1U
#define HAS_NEW 2U
#define HAS_FRAME 4U
#define HOLDS 8U
#define FRAME 19U
#define STATE ((size_t)LAW_NQ + LAW_NV)
#define MOST_VALUES (3U * STATE + 2U * LAW_NV + FRAME)
#define LARGEST_PACKET 65507U
#define REPLY (HEAD + 8U * LAW_NV)
#define MOST_FLIGHTS 64U

typedef struct {
  uint16_t flags;
  uint64_t run, sample;
  double time;
  size_t size; /* number of values */
  double values[MOST_VALUES];
} request;

typedef struct {
  bool is_used;
  uint64_t run, sample, last_use;
  law_state state;
  uint8_t reply[REPLY]; /* to the last sample */
} flight;

typedef enum {
  ANSWERED,
  OUTDATED, /* older than the last request of its run: neither answered nor refused */
  NO_PACKET,
  OTHER_SIZE,
  NOT_FINITE,
  WRONG_TIME,
  NO_CAPTURE,
  NO_FRAME,
  NOT_OK,
  NUM_OUTCOMES
} outcome;

static const char *const REASONS[NUM_OUTCOMES] = {
  "", "", "what is no packet of this version", "a request of another size: another spacecraft",
  "a request with numbers that are not finite, or beyond 1e9",
  "a request whose time is not its sample times the sample time",
  "a request of a phase without a target: the mission has no capture",
  "a request without the desired frame, which the law reads", "a request whose sample is not LAW_OK"};

static volatile sig_atomic_t ends;

static void end(int number)
{
  (void)number;
  ends = 1;
}

static uint64_t whole_at(const uint8_t *data, size_t size)
{
  uint64_t value = 0U;
  size_t i;
  for (i = size; i > 0U; --i) {
    value = (value << 8) | data[i - 1U];
  }
  return value;
}

static void write_whole(uint8_t *data, uint64_t value, size_t size)
{
  size_t i;
  for (i = 0U; i < size; ++i) {
    data[i] = (uint8_t)(value >> (8U * i));
  }
}

static double real_at(const uint8_t *data)
{
  const uint64_t bits = whole_at(data, 8U);
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static void write_real(uint8_t *data, double value)
{
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  write_whole(data, bits, 8U);
}

static outcome read_request(const uint8_t *data, size_t size, request *made)
{
  size_t expected = 2U * STATE + 2U * LAW_NV, i;
  if ((size < HEAD) || (((size - HEAD) % 8U) != 0U) || (memcmp(data, "FFSM", 4U) != 0)
      || (whole_at(&data[4], 2U) != VERSION)) {
    return NO_PACKET;
  }
  made->flags = (uint16_t)whole_at(&data[6], 2U);
  if ((made->flags & ~(IS_FIRST | HAS_NEW | HAS_FRAME | HOLDS)) != 0U) {
    return NO_PACKET;
  }
  made->run = whole_at(&data[8], 8U);
  made->sample = whole_at(&data[16], 8U);
  made->time = real_at(&data[24]);
  made->size = (size - HEAD) / 8U;
  expected += ((made->flags & HAS_NEW) != 0U) ? STATE : 0U;
  expected += ((made->flags & HAS_FRAME) != 0U) ? FRAME : 0U;
  if (made->size != expected) {
    return OTHER_SIZE;
  }
  for (i = 0U; i < made->size; ++i) {
    made->values[i] = real_at(&data[HEAD + 8U * i]);
    if (!(fabs(made->values[i]) <= 1e9)) {
      return NOT_FINITE;
    }
  }
  return ANSWERED;
}

/* Whether a request is for this law. */
static outcome check_request(const request *given)
{
  const double period = (double)LAW_SAMPLE_TIME;
  if ((given->sample > UINT32_MAX)
      || !(fabs(given->time - (double)given->sample * period) < 0.5 * period)) {
    return WRONG_TIME;
  }
  if (!LAW_HAS_CAPTURE && ((given->flags & HOLDS) == 0U)) {
    return NO_CAPTURE;
  }
  if (LAW_READS_FRAME && ((given->flags & HAS_FRAME) == 0U)) {
    return NO_FRAME;
  }
  return ANSWERED;
}

/* law_in begins with its numbers in the order of a request. */
static void fill(const request *given, law_in *in)
{
  const size_t common = 2U * STATE + 2U * LAW_NV;
  law_real numbers[LAW_NUM_INPUTS];
  size_t at = common, to = common, i;
  for (i = 0U; i < common; ++i) {
    numbers[i] = (law_real)given->values[i];
  }
  if ((given->flags & HAS_NEW) != 0U) {
    at += STATE;
  }
#if LAW_READS_IS_NEW
  for (i = 0U; i < STATE; ++i) { /* without flags all is new */
    numbers[to + i] = ((given->flags & HAS_NEW) != 0U) ? (law_real)given->values[common + i]
                                                       : (law_real)1;
  }
  to += STATE;
#endif
#if LAW_READS_FRAME
  for (i = 0U; i < FRAME; ++i) {
    numbers[to + i] = (law_real)given->values[at + i];
  }
#endif
  (void)at;
  (void)to;
  memset(in, 0, sizeof *in);
  memcpy(in, numbers, sizeof numbers);
  in->sample = (uint32_t)given->sample;
  in->is_first = given->flags & IS_FIRST;
  in->holds = ((given->flags & HOLDS) != 0U) ? 1U : 0U;
}

static flight flights[MOST_FLIGHTS];

/* The flight of a run; else an unused one, or the one whose last request is the oldest. */
static flight *flight_of(uint64_t run)
{
  flight *oldest = &flights[0];
  size_t i;
  for (i = 0U; i < MOST_FLIGHTS; ++i) {
    if (flights[i].is_used && (flights[i].run == run)) {
      return &flights[i];
    }
    if (flights[i].last_use < oldest->last_use) {
      oldest = &flights[i];
    }
  }
  return oldest;
}

/* A step of the law; the reply is then that of the flight. */
static outcome answer(const uint8_t *data, size_t size, flight **found)
{
  static uint64_t uses;
  request given;
  law_in in;
  law_out out;
  law_state state;
  flight *own;
  bool is_known;
  size_t i;
  outcome result = read_request(data, size, &given);
  if (result == ANSWERED) {
    result = check_request(&given);
  }
  if (result != ANSWERED) {
    return result;
  }
  own = flight_of(given.run);
  is_known = own->is_used && (own->run == given.run);
  *found = own;
  if (is_known && (given.sample <= own->sample)) {
    return (given.sample == own->sample) ? ANSWERED : OUTDATED;
  }
  fill(&given, &in);
  law_start(&state);
  if (is_known) {
    state = own->state;
  }
  if (law_step(&in, &LAW_GAINS, &state, &out) != LAW_OK) {
    return NOT_OK;
  }
  own->is_used = true;
  own->run = given.run;
  own->sample = given.sample;
  own->last_use = ++uses;
  own->state = state;
  memcpy(own->reply, data, HEAD);
  write_whole(&own->reply[6], 0U, 2U); /* a reply has no flags */
  for (i = 0U; i < LAW_NV; ++i) { /* the simulation limits the force itself */
    write_real(&own->reply[HEAD + 8U * i], (double)out.commanded[i]);
  }
  return ANSWERED;
}

/* A bound socket that waits at most half a second; exits with the code 2 if there is none. */
static int bound(const char *host, uint16_t port)
{
  struct sockaddr_in address;
  socklen_t length = sizeof address;
  const struct timeval longest = {0, 500000};
  char text[INET_ADDRSTRLEN] = "";
  const int made = socket(AF_INET, SOCK_DGRAM, 0);
  memset(&address, 0, sizeof address);
  address.sin_family = AF_INET;
  address.sin_port = htons(port);
  if (inet_pton(AF_INET, host, &address.sin_addr) != 1) {
    (void)fprintf(stderr, "error: --host: '%s' is no IPv4 address\n", host);
    exit(2);
  }
  if ((made < 0) || (bind(made, (const struct sockaddr *)&address, sizeof address) != 0)
      || (setsockopt(made, SOL_SOCKET, SO_RCVTIMEO, &longest, sizeof longest) != 0)
      || (getsockname(made, (struct sockaddr *)&address, &length) != 0)) {
    (void)fprintf(stderr, "error: --host, --port: cannot listen at %s, port %u: %s\n", host,
                  (unsigned)port, strerror(errno));
    exit(2);
  }
  (void)inet_ntop(AF_INET, &address.sin_addr, text, sizeof text);
  printf("listening on %s:%u\n", text, (unsigned)ntohs(address.sin_port));
  (void)fflush(stdout);
  return made;
}

static void fly(int own)
{
  static uint8_t data[LARGEST_PACKET];
  unsigned long counts[NUM_OUTCOMES] = {0U}, refused = 0U;
  int i;
  while (ends == 0) {
    struct sockaddr_in sender;
    socklen_t length = sizeof sender;
    flight *found = NULL;
    outcome result;
    const ssize_t size
      = recvfrom(own, data, sizeof data, 0, (struct sockaddr *)&sender, &length);
    if (size < 0) {
      continue; /* nothing came, a signal, or an error of an earlier reply */
    }
    result = answer(data, (size_t)size, &found);
    ++counts[result];
    if (result == ANSWERED) {
      (void)sendto(own, found->reply, sizeof found->reply, 0, (const struct sockaddr *)&sender,
                   length);
    } else if ((result != OUTDATED) && (counts[result] == 1U)) {
      printf("refused: %s\n", REASONS[result]);
      (void)fflush(stdout);
    }
  }
  for (i = NO_PACKET; i < NUM_OUTCOMES; ++i) {
    refused += counts[i];
  }
  printf("answered %lu requests, refused %lu\n", counts[ANSWERED], refused);
  for (i = NO_PACKET; i < NUM_OUTCOMES; ++i) {
    if (counts[i] > 0U) {
      printf("refused %lu times: %s\n", counts[i], REASONS[i]);
    }
  }
}

/* A port number in an argument; -1: there is none. */
static long port_in(const char *text)
{
  char *last;
  const long value = strtol(text, &last, 10);
  return ((last == text) || (*last != '\0') || (value < 0) || (value > 65535)) ? -1 : value;
}

int main(int argc, char **argv)
{
  const char *host = "127.0.0.1";
  long port = 5020;
  struct sigaction action;
  int own, i;
  for (i = 1; i + 1 < argc; i += 2) {
    if (strcmp(argv[i], "--host") == 0) {
      host = argv[i + 1];
    } else if (strcmp(argv[i], "--port") == 0) {
      port = port_in(argv[i + 1]);
    } else {
      break;
    }
  }
  if ((i != argc) || (port < 0)) {
    (void)fprintf(stderr, "usage: fly [--host ADDRESS] [--port PORT]; PORT is from 0 to 65535\n");
    return 2;
  }
  if (LAW_NUM_WRENCHES > 0) {
    (void)fprintf(stderr, "error: the law reads measured wrenches, which no request has\n");
    return 2;
  }
  memset(&action, 0, sizeof action);
  action.sa_handler = end;
  (void)sigaction(SIGINT, &action, NULL);
  (void)sigaction(SIGTERM, &action, NULL);
  own = bound(host, (uint16_t)port);
  fly(own);
  (void)close(own);
  return 0;
}
