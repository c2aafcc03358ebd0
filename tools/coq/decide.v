(* What decides it; sound.v proves that it is right. What the model says is worked out over linear forms in v = [w; e_1;
   ...; e_n; x] instead of numbers, with every chance as its mean and the deviation from it, which gives the matrices of
   (17) and (18). They are eliminated in integers. *)
Require Import ZArith QArith List Bool model.
Import ListNotations.
Open Scope Q_scope.

(* Fractions whose denominators are powers of two most of the time. *)
Fixpoint strip (b d : positive) : positive * positive * positive :=
  match b, d with xO b', xO d' => let '(x, y, g) := strip b' d' in (x, y, xO g) | _, _ => (b, d, xH) end.
Definition qplus (q r : Q) : Q :=
  match Qnum q, Qnum r with
  | Z0, _ => r
  | _, Z0 => q
  | a, c => let '(b, d, g) := strip (Qden q) (Qden r) in Qmake (Zpos d * a + Zpos b * c) (b * d * g) end.
Definition qtimes (q r : Q) : Q :=
  match Qnum q, Qnum r with Z0, _ | _, Z0 => 0 | a, c => Qmake (a * c) (Qden q * Qden r) end.

(* Linear forms and symmetric matrices; entries that are left out are 0. *)
Fixpoint rplus (x y : list Q) : list Q :=
  match x, y with [], _ => y | _, [] => x | a :: x', b :: y' => qplus a b :: rplus x' y' end.
Definition rtimes (q : Q) (x : list Q) : list Q := map (qtimes q) x.
Fixpoint mplus (X Y : matrix) : matrix :=
  match X, Y with [], _ => Y | _, [] => X | x :: X', y :: Y' => rplus x y :: mplus X' Y' end.
Definition mtimes (q : Q) (X : matrix) : matrix := map (rtimes q) X.
Fixpoint product (x u : list Q) : matrix := (* of two linear forms *)
  match x, u with
  | a :: x', b :: u' => (qtimes a b :: rtimes (1 # 2) (rplus (rtimes a u') (rtimes b x'))) :: product x' u'
  | _, _ => [] end.
Definition combined (b : list Q) (X : list (list Q)) : list Q := dot (list Q) [] rplus rtimes b X.
Fixpoint lifted (P : matrix) (X : list (list Q)) : matrix := (* y'Py where y are linear forms *)
  match P, X with
  | (a :: b) :: P', x :: X' => mplus (product x (rplus (rtimes a x) (rtimes 2 (combined b X')))) (lifted P' X')
  | [] :: P', _ :: X' => lifted P' X'
  | _, _ => [] end.
Fixpoint squares (X : list (list Q)) : matrix :=
  match X with [] => [] | x :: X' => mplus (product x x) (squares X') end.

(* Products of long fractions, cut, and what that may do at most added on the diagonal. *)
Fixpoint halved (k : nat) (a : Z) (d : positive) : Q :=
  match k, d with S k', xO d' => halved k' (Z.div2 a) d' | _, _ => a # d end.
Fixpoint raised (k : nat) (a : Z) (d : positive) : Q :=
  match k, d with S k', xO d' => raised k' (Z.div2 a + 1) d' | _, _ => a # d end.
Definition cut (digits : nat) (q : Q) : Q := halved (Z.to_nat (Z.log2 (Z.abs (Qnum q))) - digits) (Qnum q) (Qden q).
Definition size (q : Q) : Q := (* |q| or more *)
  match Qnum q with Z0 => 0 | a => raised (Z.to_nat (Z.log2 (Z.abs a)) - 8) (Z.abs a) (Qden q) end.
Definition norm (x : list Q) : Q := size (fold_right qplus 0 (map size x)).
Definition shadow (x u : list Q) : list Q :=
  rtimes (1 # 2) (rplus (rtimes (norm u) (map size x)) (rtimes (norm x) (map size u))).
Definition diagonal (x : list Q) : matrix := map (fun q => [q]) x.
Definition rminus x u := rplus x (rtimes (-1) u).
Definition product_above (digits : nat) (x u : list Q) : matrix :=
  let x' := map (cut digits) x in let u' := map (cut digits) u in
  mplus (product x' u') (diagonal (rplus (shadow (rminus x x') u) (shadow x' (rminus u u')))).
Fixpoint lifted_above (digits : nat) (P : matrix) (X : list (list Q)) : matrix :=
  match P, X with
  | (a :: b) :: P', x :: X' =>
      mplus (product_above digits x (rplus (rtimes a x) (rtimes 2 (combined b X')))) (lifted_above digits P' X')
  | [] :: P', _ :: X' => lifted_above digits P' X'
  | _, _ => [] end.

(* What is left to chance: a Row whatever happens; Node a b is a and (1 or 0, less its probability) times b. *)
Inductive random := Zero | Row (r : list Q) | Node (a b : random).
Fixpoint onto (r : list Q) (t : random) : random :=
  match t with Zero => Row r | Row q => Row (rplus r q) | Node a b => Node (onto r a) b end.
Fixpoint tplus (s t : random) : random :=
  match s, t with
  | Zero, _ => t
  | Row r, _ => onto r t
  | Node _ _, Zero => s
  | Node a b, Row r => Node (onto r a) b
  | Node a b, Node c d => Node (tplus a c) (tplus b d) end.
Fixpoint ttimes (q : Q) (t : random) : random :=
  match t with Zero => Zero | Row r => Row (rtimes q r) | Node a b => Node (ttimes q a) (ttimes q b) end.
Definition left t := match t with Node a _ => a | _ => t end.
Definition right t := match t with Node _ b => b | _ => Zero end.
Definition others (p : Q) := qplus 1 (qtimes (-1) p).
Fixpoint tchance (ps : list Q) (k : nat) (t : random) : random :=
  match k with
  | O => let p := hd 0 ps in let s := tplus (left t) (ttimes (others p) (right t)) in Node (ttimes p s) s
  | S k' => Node (tchance (tl ps) k' (left t)) (tchance (tl ps) k' (right t)) end.
Fixpoint row (t : random) := match t with Zero => [] | Row r => r | Node a _ => row a end.
Definition nothing t := match t with Zero => true | _ => false end.
Fixpoint spread (digits : nat) (P : matrix) (ps : list Q) (ts : list random) : matrix := (* at least the mean of y'Py *)
  match ps with
  | [] => lifted_above digits P (map row ts)
  | p :: ps' => mplus (spread digits P ps' (map left ts))
      (if forallb nothing (map right ts) then []
       else mtimes (qtimes p (others p)) (spread digits P ps' (map right ts))) end.

(* Positive definite: eliminated in integers, all that is divided rounded, and the diagonal lowered by what that may do. *)
Fixpoint down (a : Z) (b : positive) : Z := match b with xO b' => down (Z.div2 a) b' | xH => a | _ => (a / Zpos b)%Z end.
Definition lowered (by_ : Z) (X : list (list Z)) : list (list Z) :=
  map (fun row => match row with a :: b => (a - by_)%Z :: b | [] => [] end) X.
Definition padded (k : nat) (r : list Q) := map (fun i => nth i r 0) (seq 0 k).
Fixpoint whole (k : nat) (X : matrix) : matrix :=
  match k with O => [] | S k' => padded k (hd [] X) :: whole k' (tl X) end.
Definition rounded (X : matrix) := map (map (fun q => down (Qnum q) (Qden q))) X.
Fixpoint rest_row {T} (op : T -> T -> T -> T) (row : list T) (b_i : T) (b : list T) : list T :=
  match row, b with c :: row', b_j :: b' => op c b_i b_j :: rest_row op row' b_i b' | _, _ => [] end.
Fixpoint rest {T} (by_ : T -> T) (op : T -> T -> T -> T) (X : list (list T)) (b : list T) : list (list T) :=
  match X, b with row :: X', b_i :: b' => rest_row op row (by_ b_i) b :: rest by_ op X' b' | _, _ => [] end.
Fixpoint triangle {T} (k : nat) (X : list (list T)) : bool :=
  match k, X with
  | O, [] => true
  | S m, row :: X' => (length row =? k)%nat && triangle m X'
  | _, _ => false end.
Definition places (b : list Z) : Z := Z.succ (fold_right Z.max 0 (map (fun c => Z.log2 (Z.abs c)) b))%Z.
Fixpoint positive_definite (k : nat) (X : list (list Z)) : bool :=
  match k, X with
  | O, [] => true
  | S m, (a :: b) :: X' => (* what is left is X' - b b' / a *)
      let p := places b in
      (0 <? a)%Z && (length b =? m)%nat && triangle m X' && forallb (fun c => Z.abs c <=? 2 ^ p)%Z b &&
      positive_definite m (lowered (2 * Z.of_nat m)
        (rest (fun c => c * 2 ^ p / a)%Z (fun c b_i b_j => c - down (b_i * b_j) (Z.to_pos (2 ^ p)))%Z X' b))
  | _, _ => false end.
Definition none (q : Q) := Qeq_bool q 0.
Fixpoint within (k : nat) (X : matrix) : bool := (* no entry beyond the first k rows and columns *)
  match k, X with
  | _, [] => true
  | O, _ => forallb (forallb none) X
  | S k', row :: X' => forallb none (skipn k row) && within k' X' end.
Fixpoint first (ok : nat -> bool) (digits : list nat) : bool :=
  match digits with [] => false | d :: more => if ok d then true else first ok more end.
Definition positive (k : nat) (X : nat -> matrix) : bool :=
  first (fun digits => within k (X digits) && positive_definite k (lowered (2 * Z.of_nat k)
    (rounded (mtimes (inject_Z (2 ^ Z.of_nat digits)) (whole k (X digits)))))) [64; 128; 320]%nat.

Section Decide.
Variables (f : network) (gamma : Q) (with_x : bool).
Definition axis (k : nat) : list Q := repeat 0 k ++ [1].
Definition order := (n_w f + n f * n_x f + (if with_x then n_x f else 0))%nat.
Definition w_forms := map axis (seq 0 (n_w f)).
Definition x_forms := map axis (seq (n_w f + n f * n_x f) (n_x f)).
Definition e_forms i := map axis (seq (n_w f + i * n_x f) (n_x f)).
Definition st_forms : state (list Q) :=
  (x_forms, map (fun i => sub (list Q) rplus rtimes x_forms (e_forms i)) (seq 0 (n f))).
Definition eta_forms := eta (list Q) rplus rtimes with_x st_forms.
Definition z_forms := z (list Q) [] rplus rtimes f st_forms.
Definition next_forms s := eta random tplus ttimes with_x
  (step random Zero tplus ttimes (tchance (chances f)) f s (map Row x_forms, map (map Row) (snd st_forms)) (map Row w_forms)).
Definition likely s := nth s (Pi f) [].
Definition mixed s (P : list matrix) := fold_right mplus [] (map (fun t => mtimes (entry s t (Pi f) 0) (nth t P [])) (seq 0 (modes f))).
Definition matrix_17 forms s (here : matrix) (next : list matrix) digits := (* times the sum of the row of Pi *)
  mplus (mtimes (fold_right qplus 0 (likely s)) (mplus (squares w_forms) (lifted here eta_forms)))
        (mtimes (-1) (spread digits (mixed s next) (chances f) (nth s forms []))).
Definition matrix_18 (here : matrix) :=
  mplus (mtimes (qtimes gamma gamma) (lifted here eta_forms)) (mtimes (-1) (squares z_forms)).
Definition every (ok : nat -> bool) := forallb ok (seq 0 (modes f)).
Definition decide_17 forms (here next : list matrix) := every (fun s => positive order (matrix_17 forms s (nth s here []) next)).
Definition decide_18 (here : list matrix) :=
  every (fun s => positive order (fun _ => mplus (squares w_forms) (matrix_18 (nth s here [])))).
Fixpoint chain forms (levels : list (list matrix)) : bool :=
  match levels with
  | [] => false
  | P :: below =>
      match below with [] => decide_17 forms P P | P' :: _ => if decide_17 forms P' P then chain forms below else false end end.
Definition all_forms := map next_forms (seq 0 (modes f)).
Definition decide (levels : list (list matrix)) :=
  proper f && Qle_bool 0 gamma && decide_18 (hd [] levels) && chain all_forms levels.
End Decide.
