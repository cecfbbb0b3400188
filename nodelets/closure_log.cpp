#include "closure_log.hpp"

#include <stdexcept>

#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {

ClosureLog::ClosureLog(const std::string& path) : path_(path), file_(path) {
  file_.precision(12);
  file_ << "stamp_query,stamp_target,robot_query,robot_target,x,y,z,qx,qy,qz,qw,inliers,candidates,rms_m" << std::endl;
  if (!file_) throw std::runtime_error("can't write " + path_ + ": does its folder exist, and may it be written?");
}

void ClosureLog::Add(const Closure& closure) {
  const Eigen::Vector3d t = closure.T_target_query.translation();
  const Eigen::Quaterniond q = Eigen::Quaterniond(closure.T_target_query.linear()).normalized();
  file_ << FormatSeconds(closure.stamp_query_ns) << ',' << FormatSeconds(closure.stamp_target_ns) << ','
        << closure.robot_query << ',' << closure.robot_target << ',' << t.x() << ',' << t.y() << ',' << t.z() << ','
        << q.x() << ',' << q.y() << ',' << q.z() << ',' << q.w() << ',' << closure.inliers << ',' << closure.candidates
        << ',' << closure.rms_m << std::endl;
  if (!file_) throw std::runtime_error("writing " + path_ + " failed: is the disk full?");
}

}  // namespace incremental_segmatch
