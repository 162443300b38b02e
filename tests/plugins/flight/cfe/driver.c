/* Gives the application of a kit the messages of a recorded run, over the stand-in of cFE, and
   compares the forces that it transmits. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "cfs_app.c"
#include "recording.h"

static recording run;
static size_t sample, place, transmitted;
static double largest, difference;
static union {
  CFE_SB_Buffer_t buffer;
  law_app_measurement measurement;
  law_app_reference reference;
  law_app_applied applied;
  CFE_MSG_CommandHeader_t command;
} message;

static const CFE_SB_MsgId_Atom_t ORDER[] = {
  LAW_APP_CMD_MID, LAW_APP_REFERENCE_MID, LAW_APP_APPLIED_MID, LAW_APP_MEASUREMENT_MID,
  LAW_APP_WAKEUP_MID};
#define NUM_ORDER (sizeof ORDER / sizeof ORDER[0])

bool CFE_ES_RunLoop(uint32 *RunStatus)
{
  return (*RunStatus == CFE_ES_RunStatus_APP_RUN) && (sample < run.count);
}

void CFE_ES_ExitApp(uint32 ExitStatus)
{
  printf("exit %u, %u forces, refused %u, ratio %.3g\n", (unsigned)ExitStatus,
         (unsigned)transmitted, (unsigned)LAW_APP_Data.refused, difference / largest);
}

CFE_Status_t CFE_EVS_Register(const void *Filters, uint16 NumEventFilters, uint16 FilterScheme)
{
  (void)Filters;
  (void)NumEventFilters;
  (void)FilterScheme;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_EVS_SendEvent(uint16 EventID, CFE_EVS_EventType_Enum_t EventType,
                               const char *Spec, ...)
{
  (void)EventType;
  if (EventID != LAW_APP_COMMAND_EID) {
    printf("event %s\n", Spec);
  }
  return CFE_SUCCESS;
}

CFE_Status_t CFE_SB_CreatePipe(CFE_SB_PipeId_t *PipeIdPtr, uint16 Depth, const char *PipeName)
{
  (void)Depth;
  (void)PipeName;
  *PipeIdPtr = 7;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_SB_Subscribe(CFE_SB_MsgId_t MsgId, CFE_SB_PipeId_t PipeId)
{
  return ((MsgId.Value != 0U) && (PipeId == 7U)) ? CFE_SUCCESS : (CFE_Status_t)-1;
}

CFE_Status_t CFE_SB_ReceiveBuffer(CFE_SB_Buffer_t **BufPtr, CFE_SB_PipeId_t PipeId, int32 TimeOut)
{
  const law_in *in = &run.samples[sample].in;
  (void)PipeId;
  (void)TimeOut;
  memset(&message, 0, sizeof message);
  message.buffer.Msg.id = ORDER[place];
  switch (ORDER[place]) {
    case LAW_APP_MEASUREMENT_MID:
      message.buffer.Msg.size = sizeof message.measurement;
      memcpy(message.measurement.q, in->q, sizeof in->q);
      memcpy(message.measurement.v, in->v, sizeof in->v);
      break;
    case LAW_APP_REFERENCE_MID:
      message.buffer.Msg.size = sizeof message.reference;
      memcpy(message.reference.q_d, in->q_d, sizeof in->q_d);
      memcpy(message.reference.v_d, in->v_d, sizeof in->v_d);
      memcpy(message.reference.a_d, in->a_d, sizeof in->a_d);
      break;
    case LAW_APP_APPLIED_MID:
      message.buffer.Msg.size = sizeof message.applied;
      memcpy(message.applied.force, in->applied_force, sizeof in->applied_force);
      break;
    default: /* a command of a wrong length at the first sample */
      message.buffer.Msg.size = sizeof message.command + ((sample == 0U) ? 1U : 0U);
      break;
  }
  place = (place + 1U) % NUM_ORDER;
  *BufPtr = &message.buffer;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_SB_TransmitMsg(const CFE_MSG_Message_t *MsgPtr, bool IsOrigination)
{
  law_app_force made;
  int i;
  memcpy(&made, MsgPtr, sizeof made);
  for (i = 0; i < LAW_NV; ++i) {
    const double wanted = run.samples[sample].commanded[i];
    largest = fmax(largest, fabs(wanted));
    difference = fmax(difference, fabs((double)made.out.commanded[i] - wanted));
  }
  transmitted += ((MsgPtr->id == LAW_APP_FORCE_MID) && IsOrigination) ? 1U : 0U;
  ++sample;
  return CFE_SUCCESS;
}

void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr)
{
  (void)MsgPtr;
}

CFE_SB_MsgId_Atom_t CFE_SB_MsgIdToValue(CFE_SB_MsgId_t MsgId)
{
  return MsgId.Value;
}

CFE_SB_MsgId_t CFE_SB_ValueToMsgId(CFE_SB_MsgId_Atom_t MsgIdValue)
{
  const CFE_SB_MsgId_t made = {MsgIdValue};
  return made;
}

CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, CFE_MSG_Size_t Size)
{
  MsgPtr->id = MsgId.Value;
  MsgPtr->size = Size;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_MSG_GetSize(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_Size_t *Size)
{
  *Size = MsgPtr->size;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_MSG_GetMsgId(const CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t *MsgId)
{
  MsgId->Value = MsgPtr->id;
  return CFE_SUCCESS;
}

CFE_Status_t CFE_MSG_GetFcnCode(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_FcnCode_t *FcnCode)
{
  *FcnCode = (CFE_MSG_FcnCode_t)MsgPtr->code;
  return CFE_SUCCESS;
}

int main(void)
{
  run = read_recording("replay.txt");
  LAW_APP_Main();
  return 0;
}
