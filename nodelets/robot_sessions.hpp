/// \file
/// Robots whose front ends start over.
#pragma once

#include <cstdint>
#include <map>
#include <string>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Names a robot's sessions for the core, to which segment IDs and stamps of one name must be consistent: the first
/// session has the robot's own name, later ones `name#2`, `name#3`. So what a robot saw before its front end was
/// restarted stays in the map, and the two trajectories find together by a loop closure like those of two robots.
class RobotSessions {
 public:
  enum class Change {
    kNone,
    kNewRobot,
    kRestarted,  ///< another session, at a later stamp
    kRewound     ///< another session, at an earlier stamp: time jumped back, as when a bag is played again
  };
  struct Session {
    std::string name;
    Change change = Change::kNone;
  };

  /// The session that a message belongs to.
  Session Find(const std::string& robot, std::uint64_t session, StampNs stamp_ns) {
    const auto [it, is_new] = states_.try_emplace(robot, State{session, 1, stamp_ns});
    State& state = it->second;
    if (is_new) return {robot, Change::kNewRobot};
    Change change = Change::kNone;
    if (session != state.session) {
      change = stamp_ns < state.stamp_ns ? Change::kRewound : Change::kRestarted;
      state.session = session;
      ++state.number;
    }
    state.stamp_ns = stamp_ns;
    return {state.number == 1 ? robot : robot + "#" + std::to_string(state.number), change};
  }

  /// Forgets everything.
  void Clear() { states_.clear(); }

 private:
  struct State {
    std::uint64_t session;
    int number;
    StampNs stamp_ns;
  };
  std::map<std::string, State> states_;
};

}  // namespace incremental_segmatch
