/// \file
/// Our message types, beside the core's types of the same names: catkin puts messages into the package's namespace,
/// where the core has a LoopClosure of its own. In the nodelets the message is called LoopClosureMsg.
#pragma once

#define LoopClosure LoopClosureMsg
#define LoopClosurePtr LoopClosureMsgPtr
#define LoopClosureConstPtr LoopClosureMsgConstPtr
#include <incremental_segmatch/LoopClosure.h>
#undef LoopClosure
#undef LoopClosurePtr
#undef LoopClosureConstPtr

#include <incremental_segmatch/SegmentArray.h>
#include <incremental_segmatch/StepReport.h>
