/* Bad samples in a row over which the last force is held; then it is zero. */
#ifndef LAW_MOST_HELD
#define LAW_MOST_HELD LAW_HELD_SAMPLES
#endif

typedef enum {
  LAW_OK = 0,     /* the force follows from the inputs */
  LAW_HOLDS = 1,  /* a bad sample: the last good force */
  LAW_ZERO = 2    /* too many in a row: the force is zero */
} law_status;

#define LAW_BAD_MEASUREMENT 1U
#define LAW_BAD_REFERENCE 2U
#define LAW_BAD_FORCE 4U
#define LAW_BAD_OTHER 8U
#define LAW_BAD_RESULT 16U
#define LAW_BEYOND_POSITION 1U /* a joint is beyond its limits; the force is computed all the same */
#define LAW_BEYOND_RATE 2U
#define LAW_FORCE_LIMITED 4U
