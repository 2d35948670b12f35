// A plant that moves: shapes of scene.py, frame by frame, with a play button and a time slider; or
// one frame at a time ("live"), which a pointer may pull: "push" gives how far, in pixels.
const RAMP = [[255, 250, 215], [254, 217, 118], [253, 141, 60], [227, 26, 28], [128, 0, 38]];
function colour(part) {
  const at = Math.min(0.9999, Math.max(0, part)) * (RAMP.length - 1), i = Math.floor(at), f = at - i;
  return "rgb(" + RAMP[i].map((c, k) => Math.round(c + f * (RAMP[i + 1][k] - c))).join(",") + ")";
}
export default {
  template: `
    <div class="bench-film">
      <svg v-if="scene && scene.shapes" :viewBox="box" :style="{ height: height + 'px' }" preserveAspectRatio="xMidYMid meet" role="img"
        :aria-label="label" ref="svg" :class="{ 'is-live': live }"
        @pointerdown="take" @pointermove="move" @pointerup="drop" @pointercancel="drop">
        <g transform="scale(1,-1)">
          <template v-for="(s, k) in scene.shapes" :key="k">
            <polyline v-if="s.kind === 'line'" :points="points(s)" :class="'film-' + s.style" :style="{ strokeWidth: wide(s.style) }" />
            <polygon v-else-if="s.kind === 'muscle'" :points="points(s)" class="film-muscle" :fill="tone(s)" :style="{ strokeWidth: wide('') }" />
            <polygon v-else :points="points(s)" :class="'film-' + s.style" :style="{ strokeWidth: wide('') }" />
          </template>
        </g>
        <line v-if="pull" class="film-pull" :x1="pull.x0" :y1="pull.y0" :x2="pull.x" :y2="pull.y" :style="{ strokeWidth: wide('rail') }" />
      </svg>
      <p v-else class="bench-note">This plant says nothing of how it looks.</p>
      <div v-if="!live && scene && scene.shapes" class="film-bar">
        <button type="button" class="film-button" @click="turn" :aria-label="plays ? 'Pause the animation' : 'Play the animation'">{{ plays ? "❚❚" : "▶" }}</button>
        <input type="range" min="0" :max="count - 1" step="1" :value="frame" aria-label="Time in the motion" :aria-valuetext="clock" @input="seek($event.target.value)" />
        <span class="bench-unit">{{ clock }}</span>
        <select v-model.number="speed" aria-label="Speed of the animation"><option v-for="s in speeds" :key="s.v" :value="s.v">{{ s.text }}</option></select>
      </div>
    </div>`,
  props: { scene: Object, label: String, live: Boolean, height: { type: Number, default: 260 } },
  data() {
    return {
      frame: 0, plays: false, speed: 0, pull: null,
      speeds: [{ v: 0, text: "4 s each" }, { v: 1, text: "real time" }, { v: 0.1, text: "10 x slower" }],
    };
  },
  computed: {
    count() { return this.scene && this.scene.t ? this.scene.t.length : 1; },
    box() { const [l, b, r, t] = this.scene.view; return [l, -t, r - l, t - b].join(" "); },
    clock() {
      const t = this.scene.t[Math.min(this.frame, this.count - 1)], end = this.scene.t[this.count - 1];
      return end < 2 ? (1000 * t).toFixed(1) + " ms" : t.toFixed(2) + " s";
    },
  },
  watch: { scene() { if (this.frame >= this.count) this.frame = 0; } },
  unmounted() { cancelAnimationFrame(this.request); },
  methods: {
    points(s) { return s.frames[Math.min(s.frames.length - 1, this.live ? s.frames.length - 1 : this.frame)].join(" "); },
    tone(s) { return colour(0.04 + 0.92 * s.pressure[Math.min(s.pressure.length - 1, this.live ? s.pressure.length - 1 : this.frame)]); },
    wide(style) {
      const [l, b, r, t] = this.scene.view, one = Math.max((r - l) / 700, (t - b) / this.height);
      return one * ({ rod: 6, rail: 3, rope: 1.5, needle: 1.5 }[style] || 1);
    },
    seek(i) { this.frame = Number(i); this.plays = false; },
    turn() {
      this.plays = !this.plays;
      if (!this.plays) return;
      const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
      const end = this.scene.t[this.count - 1] || 1;
      const length = this.speed ? end / this.speed : still ? 10 : 4;
      const begin = performance.now() - (this.frame / this.count) * length * 1000;
      const step = (now) => {
        if (!this.plays) return;
        this.frame = Math.floor(((((now - begin) / 1000) % length) / length) * this.count);
        this.request = requestAnimationFrame(step);
      };
      this.request = requestAnimationFrame(step);
    },
    place(event) {
      const m = this.$refs.svg.getScreenCTM().inverse();
      const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(m);
      return { x: p.x, y: p.y };
    },
    take(event) {
      if (!this.live) return;
      this.$refs.svg.setPointerCapture(event.pointerId);
      const p = this.place(event);
      this.from = { x: event.clientX, y: event.clientY };
      this.pull = { x0: p.x, y0: p.y, x: p.x, y: p.y };
    },
    move(event) {
      if (!this.pull) return;
      const p = this.place(event);
      this.pull.x = p.x; this.pull.y = p.y;
      const now = performance.now();
      if (now - (this.at || 0) > 40) { this.at = now; this.$emit("push", { x: event.clientX - this.from.x, y: this.from.y - event.clientY }); }
    },
    drop() { if (this.pull) { this.pull = null; this.$emit("push", { x: 0, y: 0 }); } },
  },
};
