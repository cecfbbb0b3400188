#include "lio_sam_adapter_nodelet.hpp"

#include <std_msgs/Float64MultiArray.h>

#include <boost/make_shared.hpp>
#include <pluginlib/class_list_macros.hpp>

namespace incremental_segmatch {
namespace {

constexpr double kWarnPeriod_s = 5.0;

}  // namespace

void LioSamAdapterNodelet::onInit() {
  publisher_ = getNodeHandle().advertise<std_msgs::Float64MultiArray>("lio_loop/loop_closure_detection", 10);
  subscriber_ = getNodeHandle().subscribe("loop_closures", 100, &LioSamAdapterNodelet::OnClosure, this);
}

void LioSamAdapterNodelet::OnClosure(const LoopClosureConstPtr& closure) {
  if (closure->robot_query != closure->robot_target) {
    if (throttle_.IsDue("robots", kWarnPeriod_s))
      NODELET_WARN("a loop closure from %s to %s is left out: LIO-SAM knows one robot only",
                   closure->robot_query.c_str(), closure->robot_target.c_str());
    return;
  }
  const auto message = boost::make_shared<std_msgs::Float64MultiArray>();
  message->data = {closure->stamp_query.toSec(), closure->stamp_target.toSec()};
  publisher_.publish(std_msgs::Float64MultiArrayConstPtr(message));
}

}  // namespace incremental_segmatch

PLUGINLIB_EXPORT_CLASS(incremental_segmatch::LioSamAdapterNodelet, nodelet::Nodelet)
