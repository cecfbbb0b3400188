/// \file
/// Parameters that change while a nodelet runs, by dynamic_reconfigure below `~tuning`.
#pragma once

#include <dynamic_reconfigure/server.h>
#include <incremental_segmatch/BackEndConfig.h>
#include <incremental_segmatch/FrontEndConfig.h>
#include <ros/node_handle.h>

#include <boost/thread/recursive_mutex.hpp>
#include <exception>
#include <functional>
#include <string>
#include <utility>

#include "node_parameters.hpp"

namespace incremental_segmatch {

/// What a client sees and sets of a nodelet's parameters.
FrontEndConfig ToConfig(const NodeletParameters<FrontEndNodeParameters>& parameters);
BackEndConfig ToConfig(const NodeletParameters<BackEndNodeParameters>& parameters);

/// The parameters with those of the configuration in their place. Throw std::invalid_argument naming the parameter that is
/// out of range.
NodeletParameters<FrontEndNodeParameters> WithConfig(NodeletParameters<FrontEndNodeParameters> parameters,
                                                     FrontEndConfig config);
NodeletParameters<BackEndNodeParameters> WithConfig(NodeletParameters<BackEndNodeParameters> parameters,
                                                    BackEndConfig config);

/// Serves a configuration. A change that `apply` refuses by an exception is taken back, and the exception's text
/// becomes the configuration's `refused`.
template <class Config>
class Tuning {
 public:
  using Apply = std::function<void(const Config&)>;

  /// \param initial  replaces what an earlier run has left on the parameter server
  /// \param apply    called with every changed configuration, in a thread of ROS
  Tuning(const ros::NodeHandle& private_nh, const Config& initial, Apply apply)
      : accepted_(initial), apply_(std::move(apply)), server_(mutex_, ros::NodeHandle(private_nh, "tuning")) {
    server_.updateConfig(initial);
    server_.setCallback([this](Config& config, std::uint32_t) { OnChange(config); });
  }

 private:
  void OnChange(Config& config) {
    if (config.__level__(accepted_) == 0) return;
    try {
      apply_(config);
      config.refused.clear();
      accepted_ = config;
    } catch (const std::exception& error) {
      config = accepted_;
      config.refused = error.what();
    }
  }

  Config accepted_;
  const Apply apply_;
  boost::recursive_mutex mutex_;
  dynamic_reconfigure::Server<Config> server_;
};

}  // namespace incremental_segmatch
