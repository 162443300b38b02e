/* Stand-in for the parts of cFE 7 that cfs_app.c uses, with the signatures of its interface. A test
   links them with a driver. */
#ifndef STAND_IN_CFE_H
#define STAND_IN_CFE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef uint8_t uint8;
typedef uint16_t uint16;
typedef int32_t int32;
typedef uint32_t uint32;
typedef int32 CFE_Status_t;
typedef size_t CFE_MSG_Size_t;
typedef uint16 CFE_MSG_FcnCode_t;
typedef uint32 CFE_SB_MsgId_Atom_t;
typedef uint32 CFE_SB_PipeId_t;
typedef uint16 CFE_EVS_EventType_Enum_t;
typedef struct {
  CFE_SB_MsgId_Atom_t Value;
} CFE_SB_MsgId_t;
typedef struct {
  uint32 id, code;
  CFE_MSG_Size_t size;
} CFE_MSG_Message_t;
typedef struct {
  CFE_MSG_Message_t Msg;
} CFE_MSG_CommandHeader_t;
typedef struct {
  CFE_MSG_Message_t Msg;
  uint8 time[8];
} CFE_MSG_TelemetryHeader_t;
typedef union {
  CFE_MSG_Message_t Msg;
  double alignment;
} CFE_SB_Buffer_t;

#define CFE_SUCCESS ((CFE_Status_t)0)
#define CFE_SB_PEND_FOREVER -1
#define CFE_SB_INVALID_MSG_ID ((CFE_SB_MsgId_t){0})
#define CFE_MSG_PTR(header) (&((header).Msg))
#define CFE_EVS_EventFilter_BINARY 0
enum { CFE_EVS_EventType_INFORMATION = 2, CFE_EVS_EventType_ERROR = 3 };
enum { CFE_ES_RunStatus_APP_RUN = 1, CFE_ES_RunStatus_APP_EXIT, CFE_ES_RunStatus_APP_ERROR };

bool CFE_ES_RunLoop(uint32 *RunStatus);
void CFE_ES_ExitApp(uint32 ExitStatus);
CFE_Status_t CFE_EVS_Register(const void *Filters, uint16 NumEventFilters, uint16 FilterScheme);
CFE_Status_t CFE_EVS_SendEvent(uint16 EventID, CFE_EVS_EventType_Enum_t EventType,
                               const char *Spec, ...);
CFE_Status_t CFE_SB_CreatePipe(CFE_SB_PipeId_t *PipeIdPtr, uint16 Depth, const char *PipeName);
CFE_Status_t CFE_SB_Subscribe(CFE_SB_MsgId_t MsgId, CFE_SB_PipeId_t PipeId);
CFE_Status_t CFE_SB_ReceiveBuffer(CFE_SB_Buffer_t **BufPtr, CFE_SB_PipeId_t PipeId, int32 TimeOut);
CFE_Status_t CFE_SB_TransmitMsg(const CFE_MSG_Message_t *MsgPtr, bool IsOrigination);
void CFE_SB_TimeStampMsg(CFE_MSG_Message_t *MsgPtr);
CFE_SB_MsgId_Atom_t CFE_SB_MsgIdToValue(CFE_SB_MsgId_t MsgId);
CFE_SB_MsgId_t CFE_SB_ValueToMsgId(CFE_SB_MsgId_Atom_t MsgIdValue);
CFE_Status_t CFE_MSG_Init(CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t MsgId, CFE_MSG_Size_t Size);
CFE_Status_t CFE_MSG_GetSize(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_Size_t *Size);
CFE_Status_t CFE_MSG_GetMsgId(const CFE_MSG_Message_t *MsgPtr, CFE_SB_MsgId_t *MsgId);
CFE_Status_t CFE_MSG_GetFcnCode(const CFE_MSG_Message_t *MsgPtr, CFE_MSG_FcnCode_t *FcnCode);

#endif
