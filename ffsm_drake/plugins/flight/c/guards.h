/* Bad samples in a row over which the last force is held; then it is zero. */
#ifndef LAW_MOST_HELD
#define LAW_MOST_HELD LAW_HELD_SAMPLES
#endif

/* A bad result after fewer good samples in a row starts the memory anew. */
#define LAW_SETTLED 10U

typedef enum {
  LAW_OK = 0,     /* the force follows from the inputs */
  LAW_HOLDS = 1,  /* a bad sample: the last good force */
  LAW_ZERO = 2    /* too many in a row: the force is zero */
} law_status;

/* Bits of causes: an input is NaN, infinite or too large, or its quaternion is not of unit length. */
#define LAW_BAD_MEASUREMENT 1U /* q, v */
#define LAW_BAD_REFERENCE 2U   /* q_d, v_d, a_d */
#define LAW_BAD_FORCE 4U       /* applied_force */
#define LAW_BAD_OTHER 8U       /* is_new, desired_frame, measured_wrench */
#define LAW_BAD_RESULT 16U     /* inputs are good, but the force or the memory is not usable */

/* Bits of warnings: the sample is good. */
#define LAW_BEYOND_POSITION 1U /* a joint is beyond its limits */
#define LAW_BEYOND_RATE 2U     /* a joint is faster than its limits */
#define LAW_FORCE_LIMITED 4U   /* force and commanded differ */
