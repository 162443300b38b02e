/* Skeleton of an application of NASA's core Flight System (cFS) around the law.

   A message of the scheduler (wake-up) makes one control sample: the last measurement goes through
   law_step, and the force goes out in a telemetry message. What you fill in is marked TO DO:

   1. message identifiers, with those of your mission
   2. who sends the measurement, and its conversion if your navigation has another layout
   3. who sends the reference, if the header has LAW_HAS_REFERENCE 0
   4. who applies the force, and its answer: the force that the actuators applied
   5. when the target is held, if the header has LAW_HAS_CAPTURE 1
   6. what your mission does at LAW_ZERO, such as a change to the safe mode

   Add this file, the law's source and its header to the application's CMakeLists.txt, compile them
   with -ffp-contract=off, and name LAW_APP_Main as the entry point in the startup script. It uses
   the interface of cFE 7. The message structs have the layout of law_in on the same processor. */
#include <stdbool.h>
#include <string.h>

#include "cfe.h"

#include "law.h"

/* TO DO 1: identifiers of your mission, from its message ID table. */
#ifndef LAW_APP_WAKEUP_MID
#define LAW_APP_CMD_MID 0x18D0         /* ground commands */
#define LAW_APP_WAKEUP_MID 0x18D1      /* scheduler, each LAW_SAMPLE_TIME */
#define LAW_APP_MEASUREMENT_MID 0x08D0 /* navigation */
#define LAW_APP_REFERENCE_MID 0x08D1   /* guidance */
#define LAW_APP_APPLIED_MID 0x08D2     /* actuators */
#define LAW_APP_TARGET_MID 0x08D3      /* gripper */
#define LAW_APP_FORCE_MID 0x08D4       /* output */
#endif

#define LAW_APP_PIPE_DEPTH 16
#define LAW_APP_NOOP_CC 0
#define LAW_APP_RESTART_CC 1 /* the law begins without memory */

#define LAW_APP_STARTED_EID 1
#define LAW_APP_FAILED_EID 2
#define LAW_APP_COMMAND_EID 3
#define LAW_APP_MESSAGE_EID 4
#define LAW_APP_STATUS_EID 5

typedef struct {
  CFE_MSG_TelemetryHeader_t header;
  law_real q[LAW_NQ];
  law_real v[LAW_NV];
} law_app_measurement;

typedef struct {
  CFE_MSG_TelemetryHeader_t header;
  law_real q_d[LAW_NQ];
  law_real v_d[LAW_NV];
  law_real a_d[LAW_NV];
} law_app_reference;

typedef struct {
  CFE_MSG_TelemetryHeader_t header;
  law_real force[LAW_NV];
} law_app_applied;

typedef struct {
  CFE_MSG_TelemetryHeader_t header;
  uint32_t holds;
} law_app_target;

typedef struct {
  CFE_MSG_TelemetryHeader_t header;
  law_out out;
} law_app_force;

typedef struct {
  uint32 run_status;
  CFE_SB_PipeId_t pipe;
  law_in in;
  law_state state;
  law_app_force force;
  uint32_t status;   /* of the last sample */
  uint32_t refused;  /* messages of another length, and unknown commands */
} law_app_data;

static law_app_data LAW_APP_Data;

void LAW_APP_Main(void);

/* The law without memory, and its inputs at rest. */
static void LAW_APP_Restart(void)
{
  law_start(&LAW_APP_Data.state);
  memset(&LAW_APP_Data.in, 0, sizeof LAW_APP_Data.in);
  LAW_APP_Data.in.is_first = 1U;
  LAW_APP_Data.status = (uint32_t)LAW_OK;
#if LAW_READS_IS_NEW
  {
    int i;
    for (i = 0; i < LAW_NQ + LAW_NV; ++i) {
      LAW_APP_Data.in.is_new[i] = (law_real)1; /* TO DO 2: 0 where a measurement is repeated */
    }
  }
#endif
}

/* One control sample. A missing measurement is all zero, so that its quaternion is refused. */
static void LAW_APP_Sample(void)
{
  law_app_data *own = &LAW_APP_Data;
  law_status status;
#if LAW_HAS_REFERENCE
  law_reference(own->in.sample, &own->in);
#endif
  status = law_step(&own->in, &LAW_GAINS, &own->state, &own->force.out);
  CFE_SB_TimeStampMsg(CFE_MSG_PTR(own->force.header));
  (void)CFE_SB_TransmitMsg(CFE_MSG_PTR(own->force.header), true);
  if ((uint32_t)status != own->status) { /* TO DO 6 */
    (void)CFE_EVS_SendEvent(LAW_APP_STATUS_EID, CFE_EVS_EventType_ERROR,
                            "law: status %u, causes 0x%X at sample %u", (unsigned int)status,
                            (unsigned int)own->force.out.causes, (unsigned int)own->in.sample);
  }
  own->status = (uint32_t)status;
  /* a measurement that does not come again is bad */
  memset(own->in.q, 0, sizeof own->in.q);
  own->in.is_first = 0U;
  own->in.sample += 1U;
}

/* Whether a message has the length of its struct. */
static bool LAW_APP_HasLength(const CFE_SB_Buffer_t *buffer, size_t expected)
{
  CFE_MSG_Size_t size = 0;
  (void)CFE_MSG_GetSize(&buffer->Msg, &size);
  if (size == expected) {
    return true;
  }
  ++LAW_APP_Data.refused;
  (void)CFE_EVS_SendEvent(LAW_APP_MESSAGE_EID, CFE_EVS_EventType_ERROR,
                          "law: a message of %u bytes, not %u", (unsigned int)size,
                          (unsigned int)expected);
  return false;
}

static void LAW_APP_Command(const CFE_SB_Buffer_t *buffer)
{
  CFE_MSG_FcnCode_t code = 0;
  (void)CFE_MSG_GetFcnCode(&buffer->Msg, &code);
  if (!LAW_APP_HasLength(buffer, sizeof(CFE_MSG_CommandHeader_t))) {
    return;
  }
  if (code == LAW_APP_RESTART_CC) {
    LAW_APP_Restart();
  } else if (code != LAW_APP_NOOP_CC) {
    ++LAW_APP_Data.refused;
  }
  (void)CFE_EVS_SendEvent(LAW_APP_COMMAND_EID, CFE_EVS_EventType_INFORMATION, "law: command %u",
                          (unsigned int)code);
}

/* TO DO 2, 3, 4, 5: if your messages have another layout, convert it to law_in here. */
static void LAW_APP_Message(const CFE_SB_Buffer_t *buffer)
{
  law_in *in = &LAW_APP_Data.in;
  CFE_SB_MsgId_t id = CFE_SB_INVALID_MSG_ID;
  (void)CFE_MSG_GetMsgId(&buffer->Msg, &id);
  switch (CFE_SB_MsgIdToValue(id)) {
    case LAW_APP_WAKEUP_MID:
      LAW_APP_Sample();
      break;
    case LAW_APP_MEASUREMENT_MID:
      if (LAW_APP_HasLength(buffer, sizeof(law_app_measurement))) {
        const law_app_measurement *given = (const law_app_measurement *)(const void *)buffer;
        memcpy(in->q, given->q, sizeof in->q);
        memcpy(in->v, given->v, sizeof in->v);
      }
      break;
    case LAW_APP_REFERENCE_MID:
      if (LAW_APP_HasLength(buffer, sizeof(law_app_reference))) {
        const law_app_reference *given = (const law_app_reference *)(const void *)buffer;
        memcpy(in->q_d, given->q_d, sizeof in->q_d);
        memcpy(in->v_d, given->v_d, sizeof in->v_d);
        memcpy(in->a_d, given->a_d, sizeof in->a_d);
      }
      break;
    case LAW_APP_APPLIED_MID:
      if (LAW_APP_HasLength(buffer, sizeof(law_app_applied))) {
        const law_app_applied *given = (const law_app_applied *)(const void *)buffer;
        memcpy(in->applied_force, given->force, sizeof in->applied_force);
      }
      break;
    case LAW_APP_TARGET_MID:
      if (LAW_APP_HasLength(buffer, sizeof(law_app_target))) {
        const law_app_target *given = (const law_app_target *)(const void *)buffer;
        in->holds = (given->holds != 0U) ? 1U : 0U;
      }
      break;
    case LAW_APP_CMD_MID:
      LAW_APP_Command(buffer);
      break;
    default:
      ++LAW_APP_Data.refused;
      break;
  }
}

static CFE_Status_t LAW_APP_Start(void)
{
  static const CFE_SB_MsgId_Atom_t wanted[] = {
    LAW_APP_CMD_MID, LAW_APP_WAKEUP_MID, LAW_APP_MEASUREMENT_MID, LAW_APP_REFERENCE_MID,
    LAW_APP_APPLIED_MID, LAW_APP_TARGET_MID};
  CFE_Status_t status;
  size_t i;
  memset(&LAW_APP_Data, 0, sizeof LAW_APP_Data);
  LAW_APP_Data.run_status = CFE_ES_RunStatus_APP_RUN;
  LAW_APP_Restart();
  status = CFE_EVS_Register(NULL, 0, CFE_EVS_EventFilter_BINARY);
  if (status == CFE_SUCCESS) {
    status = CFE_MSG_Init(CFE_MSG_PTR(LAW_APP_Data.force.header),
                          CFE_SB_ValueToMsgId(LAW_APP_FORCE_MID), sizeof LAW_APP_Data.force);
  }
  if (status == CFE_SUCCESS) {
    status = CFE_SB_CreatePipe(&LAW_APP_Data.pipe, LAW_APP_PIPE_DEPTH, "LAW_PIPE");
  }
  for (i = 0; (i < sizeof wanted / sizeof wanted[0]) && (status == CFE_SUCCESS); ++i) {
    status = CFE_SB_Subscribe(CFE_SB_ValueToMsgId(wanted[i]), LAW_APP_Data.pipe);
  }
  if (status == CFE_SUCCESS) {
    (void)CFE_EVS_SendEvent(LAW_APP_STARTED_EID, CFE_EVS_EventType_INFORMATION, "law: started");
  }
  return status;
}

void LAW_APP_Main(void)
{
  CFE_SB_Buffer_t *buffer = NULL;
  CFE_Status_t status = LAW_APP_Start();
  if (status != CFE_SUCCESS) {
    LAW_APP_Data.run_status = CFE_ES_RunStatus_APP_ERROR;
  }
  while (CFE_ES_RunLoop(&LAW_APP_Data.run_status)) {
    status = CFE_SB_ReceiveBuffer(&buffer, LAW_APP_Data.pipe, CFE_SB_PEND_FOREVER);
    if (status == CFE_SUCCESS) {
      LAW_APP_Message(buffer);
    } else {
      (void)CFE_EVS_SendEvent(LAW_APP_FAILED_EID, CFE_EVS_EventType_ERROR,
                              "law: the pipe fails, 0x%08lX", (unsigned long)status);
      LAW_APP_Data.run_status = CFE_ES_RunStatus_APP_ERROR;
    }
  }
  CFE_ES_ExitApp(LAW_APP_Data.run_status);
}
