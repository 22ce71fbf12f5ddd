"""The base of scripted.py with real rospy, at the master of the environment: ``rospy_base.py base NAME MASTER LOG``."""

import os
import sys
import time
from pathlib import Path

import rospy
from actionlib_msgs.msg import GoalID, GoalStatus, GoalStatusArray
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from std_msgs.msg import Bool

log = Path(sys.argv[-1]).open("a", buffering=1)  # noqa: SIM115 - until it is killed
do = Path(sys.argv[-1] + ".do")


def note(*words):
    log.write(" ".join(map(str, (time.monotonic_ns(), *words))) + "\n")


def base():
    state = {"speed": 0.0, "turn": 0.0, "x": 0.0, "goal": 0, "quiet": False}

    def moved(message):
        state["speed"], state["turn"] = message.linear.x, message.angular.z
        note("cmd", f"{message.linear.x:.6f}", f"{message.angular.z:.6f}")

    rospy.init_node(sys.argv[2], disable_signals=True)
    note("up", os.getpid())
    rospy.Subscriber("/cmd_vel", Twist, moved)
    rospy.Subscriber("/e_stop", Bool, lambda message: note("estop", message.data))
    rospy.Subscriber("/move_base/cancel", GoalID, lambda _: note("cancel"))
    odometry = rospy.Publisher("/odometry/filtered", Odometry, queue_size=1)
    diagnostics = rospy.Publisher("/diagnostics_agg", DiagnosticArray, queue_size=1)
    status = rospy.Publisher("/move_base/status", GoalStatusArray, queue_size=1)
    goal = rospy.Publisher("/move_base/current_goal", PoseStamped, queue_size=1, latch=True)
    number = 0
    while True:
        time.sleep(0.02)
        number += 1
        state["x"] += state["speed"] / 50
        if do.exists():
            line = do.read_text()
            do.unlink()
            state["goal"] = {"goal active": 1, "goal done": 3}.get(line, state["goal"])
            state["quiet"] = {"quiet": True, "loud": False}.get(line, state["quiet"])
            if line == "goal active":
                place = PoseStamped()
                place.header.frame_id, place.header.stamp = "map", rospy.Time.now()
                place.pose.position.x, place.pose.position.y, place.pose.orientation.w = 1.0, 2.0, 1.0
                goal.publish(place)
        if not state["quiet"]:
            message = Odometry()
            message.header.stamp, message.header.frame_id = rospy.Time.now(), "odom"
            message.child_frame_id = "base_link"
            message.pose.pose.position.x, message.pose.pose.position.y = state["x"], 0.5
            message.pose.pose.orientation.w, message.twist.twist.linear.x = 1.0, state["speed"]
            message.twist.twist.angular.z = state["turn"]
            odometry.publish(message)
        if number % 10 == 0:
            message = GoalStatusArray()
            message.header.stamp = rospy.Time.now()
            if state["goal"]:
                known = GoalStatus(status=state["goal"], text="on its way")
                known.goal_id.id = "goal-1"
                message.status_list = [known]
            status.publish(message)
        if number % 50 == 0:
            message = DiagnosticArray()
            message.header.stamp = rospy.Time.now()
            values = [KeyValue("Charge (%)", "87.5")]
            part = DiagnosticStatus(level=0, name="/Other/husky_node: power_status", message="ok", values=values)
            message.status = [part]
            diagnostics.publish(message)


base()
