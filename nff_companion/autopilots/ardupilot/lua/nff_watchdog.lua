-- Watches the applet. When it stops running while armed, puts back factors that are safe: those of the motors declared
-- failed, or the stock ones; and keeps the failed motors stopped. Ends its intervention when the applet runs again.

local P = require("nff_protocol")
local T = require("nff_times")
local airframe = require("nff_airframe")

local TEXT_CRITICAL = 2
local motors = airframe.motors
local alive, failed, watch = nil, nil, nil
local last_count, last_change_ms = -1, 0
local active, ticks = false, 0

local function safe_factors(mask)
  local factors = motor_factor_table()
  local stored = airframe.tables[mask]
  for motor = 1, motors do
    local dead = (mask >> (motor - 1)) & 1 == 1
    local throttle, roll, pitch, yaw = string.unpack("<i2i2i2i2", stored or airframe.tables[0], 8 * motor - 7)
    if dead then
      throttle, roll, pitch, yaw = 0, 0, 0, 0
    end
    factors:throttle(motor - 1, throttle / P.FACTOR_SCALE)
    factors:roll(motor - 1, roll / P.FACTOR_SCALE)
    factors:pitch(motor - 1, pitch / P.FACTOR_SCALE)
    factors:yaw(motor - 1, yaw / P.FACTOR_SCALE)
  end
  return factors
end

local function run()
  if not watch then
    -- The applet makes these parameters; until it has, there is nothing to watch.
    alive, failed, watch = Parameter("NFF_ALIVE"), Parameter("NFF_FAILED"), Parameter("NFF_WATCH")
  end
  ticks = (ticks + 1) % 30000
  watch:set(ticks)
  local now = millis():toint()
  local count = alive:get()
  if count ~= last_count then
    last_count, last_change_ms = count, now
    active = false
    return
  end
  if now - last_change_ms < T.APPLET_DEAD_MS then
    return
  end
  local mask = arming:is_armed() and math.floor(failed:get() or 0) or 0
  if not active then
    active = true
    if param:get("FRAME_CLASS") == 17 then
      Motors_dynamic:load_factors(safe_factors(mask))
    end
    gcs:send_text(TEXT_CRITICAL, string.format("NFF: applet stopped, holding motor mask %d", mask))
  end
  for motor = 1, motors do
    if (mask >> (motor - 1)) & 1 == 1 then
      local channel = SRV_Channels:find_channel((motor <= 8 and 32 or 73) + motor)
      if channel then
        SRV_Channels:set_output_pwm_chan_timeout(channel, airframe.pwm_min, T.WATCHDOG_STOP_MS)
      end
    end
  end
end

function update()
  local good, message = pcall(run)
  if not good then
    watch = nil
    if last_count >= 0 then
      gcs:send_text(TEXT_CRITICAL, "NFF watchdog: " .. tostring(message))
    end
  end
  return update, active and T.WATCHDOG_ACTIVE_MS or T.WATCHDOG_CALM_MS
end

return update, 1000
