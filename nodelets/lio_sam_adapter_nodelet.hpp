/// \file
/// Loop closures as LIO-SAM takes them: two stamps.
#pragma once

#include <incremental_segmatch/LoopClosure.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>

#include "throttle.hpp"

namespace incremental_segmatch {

/// Tells LIO-SAM which two of its key frames see one place. Its map optimization then registers them itself, from where
/// it believes them to be: the relative pose of a LoopClosure has no place in its message.
///
/// Subscribes `loop_closures`. Publishes `lio_loop/loop_closure_detection` (std_msgs/Float64MultiArray): the newer
/// stamp, then the older, in seconds. Closures between two robots are left out: LIO-SAM knows only one. Stateless; has
/// no parameters.
class LioSamAdapterNodelet : public nodelet::Nodelet {
 private:
  void onInit() override;
  void OnClosure(const LoopClosureConstPtr& closure);

  Throttle throttle_;
  ros::Publisher publisher_;
  ros::Subscriber subscriber_;
};

}  // namespace incremental_segmatch
